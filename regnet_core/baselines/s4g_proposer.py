"""S4G as a method of ``GraspDetector``: the prepared scene in, the best grasps of its points out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from regnet_core.baselines.s4g import S4gNetwork, S4gOutput
from regnet_core.baselines.s4g_coding import best_around, decode, expected_score
from regnet_core.checks import check_range
from regnet_core.geometry import Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.nn.anchors import Pose
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.precision import autocast
from regnet_core.pointcloud import surroundings
from regnet_core.proposer import Proposals
from regnet_core.scene import Scene

_SAME = 0.004
"""A point this near to the surface of an object belongs to it [m]."""


@dataclass(frozen=True)
class S4gSelection:
    """Which of the points' grasps are given. The paper keeps the local maxima of the score and names no numbers.

    Raises:
        InvalidInputError: a number is out of range.
    """

    least_score: float = 0.1
    """Points below this expected score have no grasp."""
    most: int = 2000
    """Of more points, the best ones are looked at."""
    distance: float = 0.01
    """Centres nearer than this may be of one grasp [m]."""
    angle: float = math.radians(30)
    """Directions nearer than this may be of one grasp [rad]."""

    def __post_init__(self) -> None:
        check_range("least_score", self.least_score, 0.0, 1.0)
        check_range("most", self.most, 1)
        check_range("distance", self.distance, 0.0, 1.0, "m")
        check_range("angle", self.angle, 0.0, math.pi / 2, "rad")


class S4gProposer:
    """A trained S4G."""

    name = "s4g"

    def __init__(self, network: S4gNetwork, device: str = "cpu", selection: S4gSelection | None = None) -> None:
        """Args:
        network: trained; it is put in evaluation mode.
        device: where it runs.
        selection: which grasps are given.
        """
        self.device = torch.device(device)
        self.network = network.to(self.device).eval()
        self.selection = selection or S4gSelection()

    @torch.inference_mode()
    def propose(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Proposals:
        """The best grasps around the focused points, the jaw open at W; quality is the expected score."""
        surface = scene.objects
        seen = scene.wanted(focus) & surface.observed
        if not seen.any():
            return Proposals(Grasps.empty(), 0)
        rows = surroundings(scene.points, surface.points[surface.observed])
        # In random order: a ball query keeps the first points that it finds.
        rows = rng.permutation(rows)[: self.network.config.backbone.points]
        near, _ = cKDTree(surface.points[seen]).query(scene.points[rows], distance_upper_bound=_SAME)
        eligible = torch.from_numpy(np.flatnonzero(np.isfinite(near))).to(self.device)
        points = torch.from_numpy(scene.points[rows]).float().to(self.device)
        with autocast(self.device):
            output = self.network(Clouds.of([points], [gripper.width]))
        pose, score = self._best(points[eligible], S4gOutput(*(value[eligible] for value in output)))
        rotation, translation, quality = (
            value.double().cpu().numpy() for value in (pose.rotation, pose.translation, score)
        )
        grasps = Grasps.from_poses(rotation, translation, np.full(len(quality), gripper.width), quality)
        return Proposals(grasps, len(eligible))

    def _best(self, points: torch.Tensor, output: S4gOutput) -> tuple[Pose, torch.Tensor]:
        cfg, score = self.selection, expected_score(output.score)
        rows = score.argsort(descending=True, stable=True)[: cfg.most]
        rows = rows[score[rows] >= cfg.least_score]
        pose = decode(points[rows], output.rotation[rows], output.offset[rows], self.network.config.unit)
        kept = best_around(pose, score[rows], cfg.distance, cfg.angle)
        return Pose(pose.rotation[kept], pose.translation[kept]), score[rows][kept]
