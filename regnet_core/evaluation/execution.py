"""Executes grasps in physics: the best of a method, aimed at the object that it is on."""

from __future__ import annotations

import numpy as np
import open3d as o3d
import trimesh

from regnet_core.data.scenes.scene import Scene
from regnet_core.evaluation.ground_truth import NO_OBJECT, GroundTruth
from regnet_core.geometry import Array
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper
from regnet_core.sim.simulator import GraspSimulator

NO_GRASP = "no grasp"
"""Outcome where a method gives nothing although the scene has labelled grasps: a failure as any other."""
HELD = "held"
"""The only outcome that is a success, ``Outcome.HELD``."""
_STEPS = 5
"""Points of a closing region along each axis."""


class Execution:
    """One scene, in which any grippers try their grasps, each from the scene's own state."""

    def __init__(self, scene: Scene, truth: GroundTruth) -> None:
        self._scene = scene
        self._truth = truth
        self._surfaces = Surfaces(scene.world_meshes())
        self._simulators: dict[Gripper, GraspSimulator] = {}

    def outcome(self, grasps: Grasps, gripper: Gripper, labels: int) -> str | None:
        """How the grasp of the highest quality ends, one of the values of ``Outcome`` or NO_GRASP.

        None where there is neither a grasp nor a label: nothing was to be found, and nothing was tried.
        """
        if len(grasps) == 0:
            return NO_GRASP if labels else None
        if gripper not in self._simulators:
            self._simulators[gripper] = GraspSimulator(self._scene, gripper)
        best = grasps.ranked()[0]
        return self._simulators[gripper].attempt(best, self.target(best, gripper)).outcome.value

    def target(self, grasp: Grasps, gripper: Gripper) -> int | None:
        """The object that one grasp is on; None in a scene without objects.

        It is the one that both pads touch when they close, else the one that fills most of the closing region, else
        the one whose surface is nearest to it.
        """
        touched = int(self._truth.antipodal(grasp, gripper).object_index[0])
        if touched != NO_OBJECT:
            return touched
        between = int(self._truth.enclosed(grasp, gripper).object_index[0])
        return between if between != NO_OBJECT else self._surfaces.nearest(closing_points(grasp, gripper))


class Surfaces:
    """The surfaces of meshes in the world frame."""

    def __init__(self, meshes: list[trimesh.Trimesh]) -> None:
        self._caster = o3d.t.geometry.RaycastingScene()
        self._count = len(meshes)
        for mesh in meshes:
            self._caster.add_triangles(
                o3d.core.Tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32)),
                o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)),
            )

    def nearest(self, points: Array) -> int | None:
        """Index of the mesh that any of the points (P, 3) [m] is nearest to; None without meshes."""
        if self._count == 0:
            return None
        found = self._caster.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
        distance = np.linalg.norm(found["points"].numpy() - points, axis=1)
        return int(found["geometry_ids"].numpy()[distance.argmin()])


def closing_points(grasp: Grasps, gripper: Gripper) -> Array:
    """Points (P, 3) that are spread evenly over the closing region of one grasp, its faces included [m]."""
    box = gripper.closing_region(float(grasp.width[0]))
    axes = [np.linspace(low, high, _STEPS) for low, high in zip(box.lower, box.upper, strict=True)]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return local @ grasp.rotation[0].T + grasp.translation[0]
