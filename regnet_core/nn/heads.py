"""The Score Network's head and the Grasp Region Network's: from features of points and regions to what they mean."""

from __future__ import annotations

import math

import torch
from torch import nn

from regnet_core.nn.anchors import RESIDUALS
from regnet_core.nn.config import NetworkConfig
from regnet_core.nn.layers import Mlp, output_layer
from regnet_core.nn.results import StagePrediction

RARE = -math.log(9.0)
"""Logit of 0.1: about the share of positives before anything is learnt, which the focal loss wants to start from."""


class ScoreHead(nn.Module):
    """Point grasp confidence: a shared MLP and one logit for each point, sigmoid(logit) being in [0, 1] as eq. (1) is.

    The published code does the same with a batch normalisation of that one number, which we leave out.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.mlp = Mlp(config.features, config.head)
        self.output = output_layer(config.head[-1], 1)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Logits (N,) of features (N, C)."""
        return self.output(self.mlp(features)).float().squeeze(1)  # type: ignore[no-any-return]


class GraspHead(nn.Module):
    """Class, residuals and quality of every anchor of a region."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.anchors, last = config.anchors, config.head[-1]
        self.class_mlp = Mlp(config.features, config.head) if config.grasp_heads > 0 else None
        self.residual_mlp = Mlp(config.features, config.head) if config.grasp_heads > 1 else None
        self.class_output = output_layer(last, self.anchors, RARE)
        self.residual_output = output_layer(last, self.anchors * (RESIDUALS + 1))

    def forward(self, features: torch.Tensor, score_mlp: Mlp) -> StagePrediction:
        """Predictions (R, M) from the regions' features (R, C); without own heads it uses the Score Network's."""
        for_class = (self.class_mlp or score_mlp)(features)
        for_residual = for_class if self.residual_mlp is None else self.residual_mlp(features)
        numbers = self.residual_output(for_residual).float().view(-1, self.anchors, RESIDUALS + 1)
        return StagePrediction(self.class_output(for_class).float(), numbers[..., :RESIDUALS], numbers[..., RESIDUALS])
