"""The network as a method of ``GraspDetector``: the prepared scene in, the grasps of its positive points out."""

from __future__ import annotations

import numpy as np
import torch

from regnet_core.geometry import Mask
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.nn import precision
from regnet_core.nn.clouds import Clouds
from regnet_core.nn.decoding import decode
from regnet_core.nn.network import RegNet
from regnet_core.nn.precision import Precision
from regnet_core.ops.nearby import near_any
from regnet_core.ops.rows import taken
from regnet_core.pointcloud import surroundings
from regnet_core.proposer import Proposals
from regnet_core.scene import Scene

_SAME = 0.004
"""A point this near to the surface of an object belongs to it [m]."""


class NetworkProposer:
    """REGNet V2, or any variant of it."""

    def __init__(self, network: RegNet, device: str = "cpu") -> None:
        """Args:
        network: trained; it is put in evaluation mode.
        device: where it runs.
        """
        self.device = torch.device(device)
        self.network = network.to(self.device).eval()
        self.precision: Precision = precision.cpu_precision() if self.device.type == "cpu" else "bf16"
        if self.precision == "int8":
            self.network.use_bytes()
        self.name = network.config.name

    @torch.inference_mode()
    def propose(self, scene: Scene, gripper: Gripper, focus: Mask | None, rng: np.random.Generator) -> Proposals:
        """The refined grasps of the most confident points that are in focus."""
        # Of the objects only what the camera saw, without the hidden sides that were made up.
        seen = scene.seen if focus is None else scene.seen[focus[: len(scene.seen)]]
        if len(seen) == 0:
            return Proposals(Grasps.empty(), 0)
        rows = surroundings(scene.points, scene.seen)
        # In random order: a ball query keeps the first points that it finds, and cameras give them row after row.
        rows = rng.permutation(rows)[: self.network.config.points]
        points = taken(scene.points, rows)
        eligible = near_any(seen, points, _SAME)
        if not eligible.any():
            return Proposals(Grasps.empty(), 0)
        clouds = self._clouds(scene, points, rows, gripper)
        mask = torch.from_numpy(eligible).to(self.device)
        with precision.detecting(self.device, self.precision):
            output = self.network(clouds, gripper, eligible=mask)
        return Proposals(decode(self.network, output, clouds)[0], len(output.candidates.region))

    def _clouds(self, scene: Scene, points: np.ndarray, rows: np.ndarray, gripper: Gripper) -> Clouds:
        colors = None
        if self.network.config.colour and scene.colors is not None:
            colors = [torch.from_numpy(scene.colors[rows]).float().to(self.device)]
        return Clouds.of([torch.from_numpy(points).float().to(self.device)], [gripper.width], colors)
