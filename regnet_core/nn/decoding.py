"""From what the network gives to grasps: the refined pose of each region, and how good it is expected to be."""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.grasps import Grasps
from regnet_core.nn.anchors import Pose
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.network import RegNet
from regnet_core.nn.results import Output, best_of_regions, expected_quality


@torch.no_grad()
def decode(network: RegNet, output: Output, clouds: Clouds) -> list[Grasps]:
    """The grasp of each region of each cloud, best first, the jaw open at W.

    ``quality`` is the s_q that is to be expected: where the network learnt from judged proposals, a grasp that hits
    something counts as 0 in that. ``confidence`` is that of the positive point.
    """
    region, pose, quality, usable = _last_stage(network, output)
    regions = output.proposed.regions
    confidence = torch.sigmoid(output.proposed.confidence[regions.source])[region]
    owner = regions.cloud[region]
    grasps = []
    for cloud, width in enumerate(clouds.width.tolist()):
        rows = ((owner == cloud) & usable).nonzero().squeeze(1)
        rows = rows[quality[rows].argsort(descending=True, stable=True)]
        rows = rows[spread(pose.translation[rows], network.config.spacing)]
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


def spread(centres: torch.Tensor, spacing: float) -> torch.Tensor:
    """Which of grasps with centres (G, 3) [m], best first, have no better one within the spacing that stays -> (K,)."""
    count = len(centres)
    if spacing <= 0.0 or count == 0:
        return torch.arange(count, device=centres.device)
    near = (torch.cdist(centres.double(), centres.double()) < spacing).cpu()
    kept = torch.ones(count, dtype=torch.bool)
    for row in range(count):
        if kept[row]:
            kept[row + 1 :] &= ~near[row, row + 1 :]
    return kept.nonzero().squeeze(1).to(centres.device)


def _last_stage(network: RegNet, output: Output) -> tuple[torch.Tensor, Pose, torch.Tensor, torch.Tensor]:
    """Regions (R,), their poses, their quality (R,) in [0, 1], and which of them mean anything (R,)."""
    candidates, refined = output.candidates, output.refined
    if refined is not None:
        rows, pose = best_of_regions(candidates, refined), network.refined_pose(candidates, refined)
        pose = Pose(pose.rotation[rows], pose.translation[rows])
        return candidates.region[rows], pose, torch.sigmoid(refined.prediction.quality[rows]), refined.occupied[rows]
    quality = expected_quality(output.proposed.anchors)[candidates.region, candidates.anchor]
    return candidates.region, candidates.pose, quality, torch.ones_like(quality, dtype=torch.bool)


def _numpy(values: torch.Tensor) -> np.ndarray:
    return values.detach().double().cpu().numpy()
