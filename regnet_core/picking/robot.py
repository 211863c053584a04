"""The hand of the work cell: it tries a grasp in physics, and what came of it is judged."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from regnet_core.data.scenes.scene import Scene
from regnet_core.evaluation.ground_truth import NO_OBJECT, GroundTruth
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.picking.failures import Evidence, Verdict, judge
from regnet_core.picking.snapshot import Snapshot
from regnet_core.picking.workcell import Workcell
from regnet_core.sim.config import SimConfig
from regnet_core.sim.simulator import GraspSimulator
from regnet_core.sim.transfer import TransferConfig, TransferRecord


@dataclass(frozen=True, eq=False)
class PickAttempt:
    """What came of one grasp."""

    record: TransferRecord
    """What the hand did and met."""
    placed: tuple[int, ...]
    """The objects that came to lie in the place bin."""
    verdict: Verdict
    after: Snapshot
    """Where the objects are when all is at rest; those in the place bin, or off the table, are taken away then."""


class PickRobot:
    """A hand in the physics of a scene.

    What comes of a grasp depends on where the objects are and on the grasp, and on nothing that was before: each
    attempt of an episode can be watched without the others.
    """

    def __init__(
        self,
        scene: Scene,
        cell: Workcell,
        gripper: Gripper,
        physics: SimConfig | None = None,
        transfer: TransferConfig | None = None,
    ) -> None:
        """Args:
        scene: its objects, in any poses, and all that is fixed.
        cell: where they are placed.
        gripper: the hand.
        physics: constants of the physics and of the way to a grasp.
        transfer: heights, speeds and forces from there on.
        """
        self.scene = scene
        self.gripper = gripper
        self._cell = cell
        self._transfer = transfer or TransferConfig()
        self._simulator = GraspSimulator(scene, gripper, physics)

    def try_grasp(self, before: Snapshot, grasp: Grasps, record_every: float | None = None) -> PickAttempt:
        """Picks and places, and waits until everything is at rest.

        Args:
            before: where the objects are.
            grasp: a batch of one grasp in the world frame.
            record_every: keep the state at these intervals for pictures [s]; nothing is kept when None.

        Raises:
            InvalidInputError: not exactly one grasp, or one that this gripper cannot do.
        """
        simulator = self._simulator
        simulator.restart(before.poses(), before.removed)
        record = simulator.transfer(grasp, self._cell.place, self._transfer, record_every=record_every)
        simulator.settle()
        poses, there = simulator.poses(), set(simulator.remaining)
        placed = tuple(k for k in np.flatnonzero(self._cell.placed(poses)).tolist() if k in there)
        after = Snapshot.of(poses, set(range(len(poses))) - there | set(placed))
        return PickAttempt(record, placed, self._judge(before, grasp, record, placed), after)

    def _judge(self, before: Snapshot, grasp: Grasps, record: TransferRecord, placed: tuple[int, ...]) -> Verdict:
        evidence = Evidence(
            placed=placed,
            lifted=record.lifted,
            gripped=record.gripped,
            opening=float(grasp.width[0]),
            closed_to=record.opening,
            blocked=record.blocked,
            contact=record.contact,
            stopped=record.stopped,
            lost=record.lost,
        )
        if placed:  # what was between the fingers only matters where nothing came of it
            return judge(evidence)
        between, extent = self._between(before, grasp)
        return judge(replace(evidence, between=between, extent=extent))

    def _between(self, before: Snapshot, grasp: Grasps) -> tuple[int | None, float]:
        """The object between the open fingers, and how wide it truly is along the closing direction [m]."""
        there, poses = before.remaining, before.poses()
        meshes = [self.scene.objects[k].mesh.copy().apply_transform(poses[k]) for k in there]
        found = GroundTruth(meshes, None).enclosed(grasp, self.gripper)
        index = int(found.object_index[0])
        return (None, math.nan) if index == NO_OBJECT else (there[index], float(found.width[0]))
