"""An independent judge of grasps: exact collision and true contacts on the meshes of a scene.

It shares no code with the detectors, which only see a point cloud: collision is python-fcl on the meshes, contacts are
rays cast along the closing direction.
"""

from collections.abc import Sequence
from typing import NamedTuple

import fcl
import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import NDArray

from regnet_core.errors import InvalidInputError
from regnet_core.evaluation.enclosed import Enclosed, enclosed_solids
from regnet_core.geometry import Box
from regnet_core.grasps import Grasps
from regnet_core.gripper import Gripper

NO_OBJECT = -1
PAD_SPACING = 0.002
"""Distance between rays on a finger pad, at most [m]."""
NEAR_TIE = 0.0005
"""Hits this close behind the first one belong to the same contact [m]."""
_ASKEW = np.array([0.6123, 0.3517, 0.7081])
"""A direction that no edge is likely to lie in: a ray from inside a solid leaves it once more than it enters."""
_CHUNK = 2000  # grasps per ray-casting call: 2000 x 186 rays x 2 x 24 byte = 18 MB


class AntipodalTruth(NamedTuple):
    """Contacts of M grasps when the jaw closes from its opening `width`."""

    score: NDArray[np.float64]
    """(M,) cos(alpha_i) cos(alpha_j) in [0, 1]; 0 when a pad touches nothing, another object or something static."""
    contact_width: NDArray[np.float64]
    """(M,) distance between the two contacts along the closing direction [m]; NaN where a pad touches nothing."""
    object_index: NDArray[np.int64]
    """(M,) the object that both pads touch, or NO_OBJECT."""


class GroundTruth:
    """The true scene: watertight meshes in the world frame, a table, and fixtures such as the walls of a bin."""

    def __init__(self, meshes: Sequence[trimesh.Trimesh], table: Box | None, fixtures: Sequence[Box] = ()) -> None:
        """Args:
            meshes: K watertight meshes in the frame of the grasps that will be judged [m].
            table: solid box of the table top in that frame; None when there is none.
            fixtures: other solid boxes in that frame, obstacles as the table is.

        Raises:
            InvalidInputError: a mesh is not watertight, so that its inside is not defined.
        """
        leaky = [i for i, mesh in enumerate(meshes) if not mesh.is_watertight]
        if leaky:
            raise InvalidInputError(f"the judge needs watertight meshes; those with index {leaky} are not")
        self._solids = [_Solid(mesh) for mesh in meshes]
        self._face_normals = np.concatenate([np.zeros((0, 3)), *(mesh.face_normals for mesh in meshes)])
        self._first_face = np.cumsum([0, *(len(mesh.faces) for mesh in meshes)])[:-1]
        self._objects = o3d.t.geometry.RaycastingScene()
        for mesh in meshes:
            _add(self._objects, mesh)
        statics = [*([] if table is None else [table]), *fixtures]
        self._statics = [_static_object(box) for box in statics]
        self._caster = o3d.t.geometry.RaycastingScene()
        for mesh in meshes:
            _add(self._caster, mesh)
        self._owners = np.append(np.arange(len(meshes)), [NO_OBJECT])
        for box in statics:
            _add(self._caster, trimesh.creation.box(bounds=(box.lower, box.upper)))
        self._empty = not meshes and not statics

    def collides(self, grasps: Grasps, gripper: Gripper) -> NDArray[np.bool_]:
        """(M,) whether the palm or a finger overlaps an object, the table or a fixture, the jaw open by its `width`."""
        return np.array([self._hand_collides(grasps, i, gripper) for i in range(len(grasps))], dtype=bool)

    def antipodal(self, grasps: Grasps, gripper: Gripper) -> AntipodalTruth:
        """Where the pads touch when the jaw closes from each grasp's `width`, and how well the contacts oppose.

        Rays start on a grid over each pad (0 <= x <= depth, |z| <= height / 2) and run inwards as far as the other pad.
        A pad's contact is its first hit; the normals of hits on the same object up to NEAR_TIE behind it are averaged.
        Alpha is the angle between a finger's inward motion and the reversed outward normal; a normal along the motion,
        as met from inside an object, scores 0.
        """
        if len(grasps) == 0 or self._empty:
            m = len(grasps)
            return AntipodalTruth(np.zeros(m), np.full(m, np.nan), np.full(m, NO_OBJECT, dtype=np.int64))
        chunks = [self._antipodal(grasps[i : i + _CHUNK], gripper) for i in range(0, len(grasps), _CHUNK)]
        return AntipodalTruth(*(np.concatenate(parts) for parts in zip(*chunks, strict=True)))

    def enclosed_width(self, grasps: Grasps, gripper: Gripper) -> NDArray[np.float64]:
        """(M,) extent along the closing direction of the object that fills most of the closing region [m].

        Unlike `contact_width` it is not cut off at the pads: it is larger than the opening when the fingers stand
        inside an object that is too wide for them. NaN where no object is between the fingers.
        """
        return self.enclosed(grasps, gripper).width

    def enclosed(self, grasps: Grasps, gripper: Gripper) -> Enclosed:
        """`enclosed_width`, and which object it is of; NO_OBJECT where there is none between the fingers."""
        if len(grasps) == 0 or not self._solids:
            return Enclosed(np.full(len(grasps), np.nan), np.full(len(grasps), NO_OBJECT, dtype=np.int64))
        x, z = _pad_grid(gripper)
        local = np.stack([x, np.zeros_like(x), z], axis=1)
        chunks = [grasps[i : i + _CHUNK] for i in range(0, len(grasps), _CHUNK)]
        parts = [
            enclosed_solids(
                self._objects,
                self._face_normals,
                self._first_face,
                np.einsum("mij,rj->mri", chunk.rotation, local) + chunk.translation[:, None],
                chunk.rotation[:, :, 1],
                chunk.width,
            )
            for chunk in chunks
        ]
        return Enclosed(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _hand_collides(self, grasps: Grasps, i: int, gripper: Gripper) -> bool:
        rotation, origin = grasps.rotation[i], grasps.translation[i]
        for body in gripper.bodies(opening=float(grasps.width[i])):
            lower, upper = np.asarray(body.lower), np.asarray(body.upper)
            centre = origin + rotation @ (0.5 * (lower + upper))
            box = fcl.CollisionObject(fcl.Box(*(upper - lower)), fcl.Transform(rotation, centre))
            if any(_touch(box, static) for static in self._statics):
                return True
            radius = 0.5 * float(np.linalg.norm(upper - lower))
            if any(solid.overlaps(box, centre, radius) for solid in self._solids):
                return True
        return False

    def _antipodal(self, grasps: Grasps, gripper: Gripper) -> AntipodalTruth:
        left = self._close_pad(grasps, gripper, side=1.0)
        right = self._close_pad(grasps, gripper, side=-1.0)
        both = (left.owner >= 0) & (left.owner == right.owner)
        score = np.where(both, left.cosine * right.cosine, 0.0)
        contact_width = grasps.width - left.travel - right.travel
        return AntipodalTruth(score, contact_width, np.where(both, left.owner, NO_OBJECT))

    def _close_pad(self, grasps: Grasps, gripper: Gripper, side: float) -> "_PadContact":
        """Closes the finger at +Y (side 1) or -Y (side -1) of every grasp."""
        x, z = _pad_grid(gripper)
        m, r = len(grasps), x.size
        local = np.empty((m, r, 3))
        local[..., 0], local[..., 2] = x, z
        local[..., 1] = side * 0.5 * grasps.width[:, None]
        origins = np.einsum("mij,mrj->mri", grasps.rotation, local) + grasps.translation[:, None, :]
        motion = -side * grasps.rotation[:, :, 1]  # (M, 3)
        rays = np.concatenate([origins, np.broadcast_to(motion[:, None], origins.shape)], axis=-1).astype(np.float32)
        hit = self._caster.cast_rays(o3d.core.Tensor(rays))
        travel = hit["t_hit"].numpy().astype(np.float64)  # (M, R)
        travel[travel > grasps.width[:, None]] = np.inf
        geometry = hit["geometry_ids"].numpy().astype(np.int64)
        # Geometry ids beyond the objects (the table, fixtures) belong to nobody.
        owners = self._owners[np.minimum(geometry, len(self._owners) - 1)]
        first = travel.argmin(axis=1)
        rows = np.arange(m)
        nearest, owner = travel[rows, first], owners[rows, first]
        same = (travel <= nearest[:, None] + NEAR_TIE) & (owners == owner[:, None]) & np.isfinite(travel)
        normal = np.einsum("mr,mri->mi", same, hit["primitive_normals"].numpy().astype(np.float64))
        length = np.linalg.norm(normal, axis=1)
        cosine = -np.einsum("mi,mi->m", normal, motion) / np.maximum(length, 1e-12)
        touched = np.isfinite(nearest)
        return _PadContact(
            travel=np.where(touched, nearest, np.nan),
            cosine=np.where(touched, np.clip(cosine, 0.0, 1.0), 0.0),
            owner=np.where(touched, owner, NO_OBJECT),
        )


class _PadContact(NamedTuple):
    travel: NDArray[np.float64]
    """(M,) how far the finger moves until it touches [m]; NaN when it touches nothing."""
    cosine: NDArray[np.float64]
    """(M,) cosine of alpha, 0 when it touches nothing."""
    owner: NDArray[np.int64]
    """(M,) index of the object, NO_OBJECT for the table, a fixture or nothing."""


class _Solid:
    """A mesh as a filled body: fcl sees its surface only, so a box that is wholly inside needs a second look."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        model = fcl.BVHModel()
        model.beginModel(len(mesh.vertices), len(mesh.faces))
        model.addSubModel(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        model.endModel()
        self._surface = fcl.CollisionObject(model)
        self._inside = o3d.t.geometry.RaycastingScene()
        _add(self._inside, mesh)
        self._lower, self._upper = np.asarray(mesh.bounds)

    def overlaps(self, box: fcl.CollisionObject, centre: NDArray[np.float64], radius: float) -> bool:
        """Whether the box, whose circumscribed ball is given, overlaps the solid."""
        if np.any(centre + radius < self._lower) or np.any(centre - radius > self._upper):
            return False
        return _touch(box, self._surface) or self._contains(centre)

    def _contains(self, point: NDArray[np.float64]) -> bool:
        ray = o3d.core.Tensor(np.concatenate([point, _ASKEW])[None].astype(np.float32))
        # One thread: for a single ray, waiting for the others takes a thousand times as long on a busy machine.
        return bool(self._inside.count_intersections(ray, nthreads=1).numpy()[0] % 2)


def _touch(a: fcl.CollisionObject, b: fcl.CollisionObject) -> bool:
    return bool(fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()))


def _static_object(box: Box) -> fcl.CollisionObject:
    lower, upper = np.asarray(box.lower), np.asarray(box.upper)
    return fcl.CollisionObject(fcl.Box(*(upper - lower)), fcl.Transform(0.5 * (lower + upper)))


def _add(caster: o3d.t.geometry.RaycastingScene, mesh: trimesh.Trimesh) -> None:
    caster.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(mesh.vertices, dtype=np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(mesh.faces, dtype=np.uint32)),
    )


def _pad_grid(gripper: Gripper) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x and z of the rays on a pad, each (R,) [m]; the pad's edges are included."""
    # A hair inside the edges: a surface that ends exactly there is neither hit nor missed by rounding.
    margin = 1e-5
    x = np.linspace(margin, gripper.depth - margin, int(np.ceil(gripper.depth / PAD_SPACING)) + 1)
    half = 0.5 * gripper.height - margin
    z = np.linspace(-half, half, int(np.ceil(gripper.height / PAD_SPACING)) + 1)
    grid = np.meshgrid(x, z, indexing="ij")
    return grid[0].ravel(), grid[1].ravel()
