"""What tells the networks among the methods apart: the columns of the paper's ablation table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from regnet_core.evaluation.study import model_labels
from regnet_core.models import load_model


def network_records(models: Sequence[str]) -> list[dict[str, Any]]:
    """For each model that is one of our networks: its label, variant, parameters and operations.

    Args:
        models: as ``GraspDetector`` takes them.

    Returns:
        Records with the label, the network's name in ``nn/zoo.py``, the layer that positive points come from, how many
        they are, anchors, the radius of the regions [m] (None without regions), passes of the refinement (0 without),
        whether it knows the width and sees colours, parameters and operations for one cloud, counted as the paper does.
    """
    records = []
    for model, label in model_labels(models).items():
        network = getattr(load_model(model, "cpu").proposer, "network", None)
        if network is None:
            continue
        from regnet_core.nn.ledger import count_flops, count_parameters
        from regnet_core.nn.network import RegNet

        if not isinstance(network, RegNet):
            continue
        config = network.config
        records.append(
            {
                "label": label,
                "network": config.name,
                "layer": config.layer,
                "positives": config.positives,
                "anchors": config.anchors,
                "region": None if config.region is None else config.region.radius,
                "passes": 0 if config.refinement is None else config.refinement.passes,
                "width": config.width,
                "colour": config.colour,
                "parameters": count_parameters(config),
                "flops": count_flops(config),
            }
        )
    return records
