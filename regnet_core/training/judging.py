"""The network's own proposals of a batch, judged on the true meshes of their scenes."""

from __future__ import annotations

import torch

from regnet_core.data.dataset import GraspBatch
from regnet_core.data.labels.judge import SceneJudges
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.gripper import Gripper
from regnet_core.nn.anchors import Pose
from regnet_core.training.augmentation import unturned


class BatchJudge:
    """Says what grasps are worth: s_q, and 0 where the hand would hit something before it closes."""

    def __init__(self, archive: SceneArchive) -> None:
        self._judges = SceneJudges(archive)

    @torch.no_grad()
    def __call__(self, batch: GraspBatch, pose: Pose, sample: torch.Tensor) -> torch.Tensor:
        """(M,) for grasps (M, 3, 3), (M, 3) in the samples (M,) of a batch, each hand open at its sample's W."""
        worth = torch.zeros(len(sample), device=sample.device)
        for number, scene in enumerate(batch.scene):
            rows = (sample == number).nonzero().squeeze(1)
            if len(rows) == 0:
                continue
            some = Pose(pose.rotation[rows].cpu(), pose.translation[rows].cpu())
            there = unturned(some, batch.turn[number].cpu())
            hand = Gripper(width=round(float(batch.width[number]), 6))
            judged = self._judges[scene].judge(there.rotation.numpy(), there.translation.numpy(), hand)
            worth[rows] = torch.from_numpy(judged.score).to(worth)
        return worth
