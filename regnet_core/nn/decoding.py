"""From what the network gives to grasps: the refined pose of each region, and how good it is expected to be."""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.grasps import Grasps
from regnet_core.nn.anchors import Pose, RefineCoder
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.network import RegNet
from regnet_core.nn.results import Output


@torch.no_grad()
def decode(network: RegNet, output: Output, clouds: Clouds) -> list[Grasps]:
    """The grasps of each cloud, best first, the jaw open at W.

    ``quality`` is the probability of being a grasp times the expected s_q, of the last stage that the network has;
    ``confidence`` is that of the positive point.
    """
    pose, quality, usable = _last_stage(network, output)
    confidence = torch.sigmoid(output.proposed.confidence[output.proposed.regions.source])[output.candidates.region]
    owner = output.proposed.regions.cloud[output.candidates.region]
    grasps = []
    for cloud, width in enumerate(clouds.width.tolist()):
        rows = ((owner == cloud) & usable).nonzero().squeeze(1)
        rows = rows[quality[rows].argsort(descending=True, stable=True)]
        grasps.append(
            Grasps.from_poses(
                _numpy(pose.rotation[rows]),
                _numpy(pose.translation[rows]),
                # In single precision 0.1 m is a little more than 0.1 m, more than the gripper opens.
                np.full(len(rows), round(width, 6)),
                _numpy(quality[rows]),
                _numpy(confidence[rows]),
            )
        )
    return grasps


def _last_stage(network: RegNet, output: Output) -> tuple[Pose, torch.Tensor, torch.Tensor]:
    """Poses (G,), their quality (G,) in [0, 1], and which of them mean anything (G,)."""
    candidates = output.candidates
    if output.refined is not None:
        prediction = output.refined.prediction
        pose = RefineCoder(network.config.coder).decode(candidates.pose, prediction.residual)
        return pose, torch.sigmoid(prediction.logit) * torch.sigmoid(prediction.quality), output.refined.occupied
    anchors = output.proposed.anchors
    best = anchors.logit.argmax(dim=1)[candidates.region, None]
    both = torch.sigmoid(anchors.logit) * torch.sigmoid(anchors.quality)
    quality = both[candidates.region].gather(1, best).squeeze(1)
    return candidates.pose, quality, torch.ones_like(quality, dtype=torch.bool)


def _numpy(values: torch.Tensor) -> np.ndarray:
    return values.detach().double().cpu().numpy()
