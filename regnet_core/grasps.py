"""Grasps: a batch of parallel-jaw grasps as arrays."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from regnet_core import coder
from regnet_core.checks import as_transform
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array
from regnet_core.gripper import Gripper

_SHAPES: dict[str, tuple[int, ...]] = {
    "rotation": (3, 3),
    "translation": (3,),
    "width": (),
    "quality": (),
    "vertical_score": (),
    "confidence": (),
}


def _numbers(name: str, value: npt.ArrayLike) -> Array:
    try:
        array = np.asarray(value)
        if array.dtype.kind in "fiu":
            return array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise InvalidInputError(f"grasps' {name} must be an array of numbers: {error}") from error
    raise InvalidInputError(f"grasps' {name} must be an array of numbers, got {array.dtype}")


@dataclass(frozen=True)
class Grasps:
    """M grasps in one gravity-aligned frame (z up) [m]; results of detectors are ordered best first.

    Raises:
        InvalidInputError: an array has the wrong shape or does not hold numbers.
    """

    rotation: Array
    """(M, 3, 3): columns approach X, closing direction Y, and Z = X x Y."""
    translation: Array
    """(M, 3): the grasp centre c, on the palm's face."""
    width: Array
    """(M,): the jaw opening to command before closing, at most the gripper's W."""
    quality: Array
    """(M,): s_q in [0, 1], the antipodal score cos(alpha_i) cos(alpha_j) that the detector expects at the two contacts.

    A network gives it times the chance of being free of collision, both learnt from its own grasps as judged on the
    true meshes. ``antipodal`` lowers it where the fingers have little room or go down into space that the camera could
    not see.
    """
    vertical_score: Array
    """(M,): s_v in [0, 1], 1 when the hand points straight down."""
    confidence: Array
    """(M,): in [0, 1], how well the point the grasp came from is suited to grasping.

    A network gives the confidence of its positive point, ``antipodal`` the share of the less seen contact that the
    camera saw.
    """

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            array = _numbers(name, getattr(self, name))
            expected = (np.shape(self.rotation)[:1] or (0,)) + shape
            if array.shape != expected:
                raise InvalidInputError(f"grasps' {name} must have shape {expected}, got {array.shape}")
            object.__setattr__(self, name, array)

    @classmethod
    def from_poses(
        cls,
        rotation: npt.ArrayLike,
        translation: npt.ArrayLike,
        width: npt.ArrayLike,
        quality: npt.ArrayLike,
        confidence: npt.ArrayLike | None = None,
    ) -> Grasps:
        """Grasps in canonical form (coder.py), with the vertical score computed from the rotation."""
        canonical = coder.canonical_rotation(np.asarray(rotation, dtype=np.float64))
        confident = np.ones(len(canonical)) if confidence is None else np.asarray(confidence, dtype=np.float64)
        return cls(
            canonical,
            np.asarray(translation, dtype=np.float64),
            np.asarray(width, dtype=np.float64),
            np.asarray(quality, dtype=np.float64),
            coder.vertical_score(canonical),
            confident,
        )

    @classmethod
    def empty(cls) -> Grasps:
        """A batch without a grasp."""
        return cls(*(np.zeros((0, *shape)) for shape in _SHAPES.values()))

    @classmethod
    def concatenate(cls, batches: Iterable[Grasps]) -> Grasps:
        """All grasps of several batches, in their order."""
        parts = [cls.empty(), *batches]
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __len__(self) -> int:
        return len(self.rotation)

    def __getitem__(self, index: int | slice | npt.NDArray[np.generic] | list[int]) -> Grasps:
        chosen = [index] if isinstance(index, int | np.integer) else index
        return Grasps(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def __iter__(self) -> Iterator[Grasps]:
        return (self[i] for i in range(len(self)))

    @property
    def approach(self) -> Array:
        """(M, 3): X, the direction in which the hand moves to the object."""
        return self.rotation[:, :, 0]

    @property
    def closing(self) -> Array:
        """(M, 3): Y, the direction along which the fingers close."""
        return self.rotation[:, :, 1]

    @property
    def poses(self) -> Array:
        """(M, 4, 4): the grasp frame in the frame of the batch."""
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        poses[:, :3, :3] = self.rotation
        poses[:, :3, 3] = self.translation
        return poses

    def fingertips(self, gripper: Gripper) -> Array:
        """(M, 3): the point between the fingertips, c + D X."""
        return self.translation + gripper.depth * self.approach

    def tool_poses(self, T_grasp_tool: npt.ArrayLike) -> Array:
        """(M, 4, 4): the user's tool frame, given its pose (4, 4) in the grasp frame."""
        return self.poses @ as_transform("T_grasp_tool", T_grasp_tool)

    def transformed(self, T_target_source: npt.ArrayLike) -> Grasps:
        """The same grasps in another gravity-aligned frame, in that frame's canonical form."""
        matrix = as_transform("T_target_source", T_target_source)
        return Grasps.from_poses(
            matrix[:3, :3] @ self.rotation,
            self.translation @ matrix[:3, :3].T + matrix[:3, 3],
            self.width,
            self.quality,
            self.confidence,
        )

    def ranked(self) -> Grasps:
        """The same grasps by falling quality; ties keep their order, so the result is reproducible."""
        return self[np.argsort(-self.quality, kind="stable")]

    def save(self, path: str | Path) -> None:
        """Write an .npz with one array for each field, under the field's name."""
        target = Path(path)
        if target.suffix != ".npz":
            raise InvalidInputError(f"grasps are saved as .npz, got '{target.name}'")
        np.savez_compressed(target, **{f.name: getattr(self, f.name) for f in fields(self)})

    @classmethod
    def load(cls, path: str | Path) -> Grasps:
        """Read what ``save`` wrote; nothing is unpickled.

        Raises:
            InvalidInputError: the file is missing or not an .npz, or an array is missing or has the wrong shape or
                type.
        """
        file = Path(path)
        if not file.is_file():
            raise InvalidInputError(f"there is no file '{file}'")
        if not zipfile.is_zipfile(file):
            raise InvalidInputError(f"'{file}' is not an .npz archive of grasps")
        try:
            with np.load(file, allow_pickle=False) as data:
                missing = [name for name in _SHAPES if name not in data]
                if missing:
                    raise InvalidInputError(f"{path} holds no grasps: it lacks {', '.join(missing)}")
                return cls(**{name: data[name] for name in _SHAPES})
        except InvalidInputError:
            raise
        except Exception as error:  # numpy and zipfile raise whatever a damaged file makes them stumble over
            raise InvalidInputError(f"'{file}' cannot be read as grasps: {error}") from error
