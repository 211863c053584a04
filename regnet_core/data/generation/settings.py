"""What a data set is made of; the same settings and the same versions of the libraries give the same bytes."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from regnet_core.checks import check_range, is_number, is_whole
from regnet_core.data.labels.candidates import CandidateConfig
from regnet_core.data.labels.scene_labels import LabelConfig
from regnet_core.data.objects.library import DEFAULT_COUNTS, SPLITS
from regnet_core.data.scenes.kinds import SCENE_KINDS
from regnet_core.data.storage.compact import to_json
from regnet_core.data.storage.records import NOTHING_CODE, TABLE_CODE
from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper

KIND_SHARES: Mapping[str, float] = {"pile": 0.6, "single": 0.1, "packed": 0.15, "bin": 0.15}
"""Share of each kind of scene in a data set."""
_PAPER_CAMERAS = 4


@dataclass(frozen=True)
class GenerationSettings:
    """Raises:
    InvalidInputError: a value is out of range; the message says what would be right.
    """

    seed: int = 0
    """Of every random choice. A scene's numbers depend on the seed, the split and the scene's number, nothing else."""
    split: str = "train"
    """Which part of the object library is used: train, val or test."""
    scenes: int = 1000
    widths: tuple[float, ...] = (0.06, 0.08, 0.10, 0.12)
    """Gripper widths that grasps are labelled for [m]."""
    kinds: tuple[tuple[str, float], ...] = tuple(KIND_SHARES.items())
    """Kinds of scenes and their shares."""
    paper_views: int = 2
    """Cameras at poses of the paper, drawn from its four, each with a Kinect v2."""
    dome_views: int = 2
    """Cameras at random places on a dome, each with a random sensor."""
    objects: int = 0
    """Size of the procedural object library; 0: the split's default."""
    meshes: str = ""
    """Digest of the user's own meshes, where they take the place of the procedural library."""
    shard_size: int = 50
    """Scenes in a tar file."""
    confidence_gain: float = 2.0
    """Factor on the mean score of the best grasps near a point, inside the tanh of eq. (1)."""
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    labels: LabelConfig = field(default_factory=LabelConfig)

    def __post_init__(self) -> None:
        if self.split not in SPLITS:
            raise InvalidInputError(f"split must be one of {', '.join(SPLITS)}, got {self.split!r}")
        for name, low, high in (
            ("seed", 0, 2**31 - 1),
            ("scenes", 1, 999_999),
            ("paper_views", 0, _PAPER_CAMERAS),
            ("dome_views", 0, 16),
            ("objects", 0, 100_000),
            ("shard_size", 1, 10_000),
        ):
            value = getattr(self, name)
            if not is_whole(value):
                raise InvalidInputError(f"{name} must be a whole number, got {value!r}")
            check_range(name, value, low, high)
        if self.paper_views + self.dome_views == 0:
            raise InvalidInputError("a scene needs at least one view, got paper_views 0 and dome_views 0")
        if not self.widths or len(set(self.widths)) != len(self.widths):
            raise InvalidInputError(f"widths must be different numbers, at least one, got {self.widths}")
        for width in self.widths:
            Gripper(width=width)
        check_range("confidence_gain", self.confidence_gain, 0.01, 100.0)
        self._check_kinds()
        if self.objects == 0 and not self.meshes:
            object.__setattr__(self, "objects", DEFAULT_COUNTS[self.split])

    def _check_kinds(self) -> None:
        for kind, share in self.kinds:
            if kind not in SCENE_KINDS:
                raise InvalidInputError(f"kinds of scenes are {', '.join(SCENE_KINDS)}, got {kind!r}")
            if not is_number(share) or not 0.0 <= share < math.inf:
                raise InvalidInputError(f"the share of {kind} must be a finite number of at least 0, got {share!r}")
        if sum(share for _, share in self.kinds) <= 0.0:
            raise InvalidInputError("at least one kind of scene needs a share above 0")

    @property
    def grippers(self) -> tuple[Gripper, ...]:
        """A hand for each width."""
        return tuple(Gripper(width=width) for width in self.widths)

    @property
    def views(self) -> int:
        """Views of a scene."""
        return self.paper_views + self.dome_views

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> GenerationSettings:
        """Reads what ``to_dict`` gave.

        Raises:
            InvalidInputError: an entry is missing, unknown or out of range.
        """
        try:
            values = dict(document)
            values["widths"] = tuple(values["widths"])
            values["kinds"] = tuple((str(kind), share) for kind, share in values["kinds"])
            values["candidates"] = CandidateConfig(**values["candidates"])
            values["labels"] = LabelConfig(**values["labels"])
            return cls(**values)
        except InvalidInputError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise InvalidInputError(f"these are not the settings of a data set: {error!r}") from error

    def object_digest(self) -> str:
        """Of all that the objects and their own grasps depend on: with the same digest they can be used again."""
        relevant = (self.seed, self.split, self.objects, self.meshes, self.widths)
        return hashlib.sha256(to_json([relevant, dataclasses.asdict(self.candidates)])).hexdigest()


MOST_OBJECTS_IN_A_SCENE = min(TABLE_CODE, NOTHING_CODE) - 1
