"""The files of a scene: what is stored of it, and how it is coded.

A scene is a few members of a tar archive (WebDataset's convention: the name up to the first dot says which scene):

    000123.json               objects and their poses, table, fixtures, cameras; how many grasps there are
    000123.grasps.st.zst      the labels of every width
    000123.view0.st.zst       what camera 0 saw, with the point confidence of every width; and so on for each view

``.st.zst`` is zstd-compressed safetensors. SCHEMA changes whenever a reader has to.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from regnet_core.data.cameras.camera import Camera, Intrinsics
from regnet_core.data.cameras.rendering import FIXTURE_ID, TABLE_ID, View
from regnet_core.data.labels.scene_labels import GraspLabels, canonical_jaw, rotation_from_quaternion
from regnet_core.data.storage.compact import from_steps, pack, to_json, to_steps, unpack
from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box

SCHEMA = "regnet-scenes/1"
LENGTH_STEP = 0.00005
"""Of grasp centres and distances [m]."""
DEPTH_STEP = 0.0001
"""Of depth images [m]; 0 is no return."""
QUATERNION_STEP = 1.0 / 32767
SCORE_STEP = 1.0 / 65535
CONFIDENCE_STEP = 1.0 / 255
TABLE_CODE, FIXTURE_CODE, NOTHING_CODE = 250, 251, 255
"""Object indices below TABLE_CODE are the scene's objects."""


_LABEL_SHAPES: Mapping[str, tuple[int | None, ...]] = {
    "count": (None,),
    "translation": (None, 3),
    "quaternion": (None, 4),
    "score": (None,),
    "contacts": (None, 2),
    "entry": (None,),
    "object_index": (None,),
}
_VIEW_SHAPES: Mapping[str, tuple[int | None, ...]] = {
    "depth": (None, None),
    "colours": (None, None, 3),
    "object_index": (None, None),
    "confidence": (None, None, None),
}


@dataclass(frozen=True)
class SceneInfo:
    """What ``NNNNNN.json`` holds.

    Attributes:
        index: number of the scene.
        kind: one of ``scenes.kinds.SCENE_KINDS``.
        objects: K names of objects of the data set's library.
        poses: (K, 4, 4) T_world_object.
        table: the table top.
        fixtures: other static boxes.
        views: its cameras.
        widths: gripper widths of the labels [m].
        found: for each width how many grasps were found in all, of which some are stored.
        redraws: how many draws of the scene did not come to rest before this one.
    """

    index: int
    kind: str
    objects: tuple[str, ...]
    poses: Array
    table: Box
    fixtures: tuple[Box, ...]
    views: tuple[ViewInfo, ...]
    widths: tuple[float, ...]
    found: tuple[int, ...]
    redraws: int

    @property
    def key(self) -> str:
        """What the names of the scene's members begin with."""
        return scene_key(self.index)


@dataclass(frozen=True)
class ViewInfo:
    """One camera of a scene.

    Attributes:
        sensor: a key of ``cameras.sensors.SENSORS``.
        camera: intrinsics and pose of the whole image.
        origin: (row, column) in the whole image of the first pixel that is stored.
    """

    sensor: str
    camera: Camera
    origin: tuple[int, int]


@dataclass(frozen=True)
class ViewData:
    """What a camera saw, cut to the H rows and W columns that show the workspace.

    Attributes:
        depth: (H, W) float32 z in the optical frame [m]; NaN where there is no return.
        colours: (H, W, 3) uint8 red, green, blue.
        object_index: (H, W) index of the object, or -1 for the table, -2 for a fixture, -3 for anything else: nothing,
            the floor, or a point that floats between two surfaces.
        confidence: (widths, H, W) float32 point grasp confidence, eq. (1).
    """

    depth: npt.NDArray[np.float32]
    colours: npt.NDArray[np.uint8]
    object_index: npt.NDArray[np.int16]
    confidence: npt.NDArray[np.float32]


def scene_key(index: int) -> str:
    """What the names of a scene's members begin with."""
    return f"{index:06d}"


def info_to_bytes(info: SceneInfo) -> bytes:
    """The scene's JSON member."""
    return to_json(
        {
            "schema": SCHEMA,
            "index": info.index,
            "kind": info.kind,
            "objects": info.objects,
            "poses": info.poses.tolist(),
            "table": _box_to_list(info.table),
            "fixtures": [_box_to_list(box) for box in info.fixtures],
            "views": [_view_to_dict(view) for view in info.views],
            "widths": info.widths,
            "found": info.found,
            "redraws": info.redraws,
        }
    )


def info_from_bytes(data: bytes, what: str = "the scene") -> SceneInfo:
    """Reads the scene's JSON member.

    Raises:
        InvalidInputError: it is damaged, or of another schema.
    """
    try:
        document = json.loads(data)
        if document["schema"] != SCHEMA:
            raise InvalidInputError(f"{what} has the schema {document['schema']!r}; this version reads {SCHEMA!r}")
        return SceneInfo(
            index=int(document["index"]),
            kind=str(document["kind"]),
            objects=tuple(document["objects"]),
            poses=np.array(document["poses"], np.float64).reshape(-1, 4, 4),
            table=_box_from_list(document["table"]),
            fixtures=tuple(_box_from_list(box) for box in document["fixtures"]),
            views=tuple(_view_from_dict(view) for view in document["views"]),
            widths=tuple(document["widths"]),
            found=tuple(document["found"]),
            redraws=int(document["redraws"]),
        )
    except InvalidInputError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidInputError(f"{what} is not the JSON of a scene: {error!r}") from error


def labels_to_bytes(labels: Sequence[GraspLabels]) -> bytes:
    """The labels of every width, in the order of the scene's ``widths``."""
    every = GraspLabels.concatenate(labels)
    quaternion = Rotation.from_matrix(every.rotation).as_quat(canonical=True) if len(every) else np.zeros((0, 4))
    return pack(
        {
            "count": np.array([len(one) for one in labels], np.int32),
            "translation": to_steps(every.translation, LENGTH_STEP, np.int16),
            "quaternion": to_steps(quaternion, QUATERNION_STEP, np.int16),
            "score": to_steps(every.score, SCORE_STEP, np.uint16),
            "contacts": to_steps(every.contacts, LENGTH_STEP, np.int16),
            "entry": to_steps(every.entry, LENGTH_STEP, np.int16),
            "object_index": every.object_index.astype(np.uint8),
        }
    )


def labels_from_bytes(data: bytes, what: str = "the labels") -> list[GraspLabels]:
    """Reads what ``labels_to_bytes`` wrote: centres to 0.025 mm, rotations to 0.1 mrad.

    Raises:
        InvalidInputError: it is damaged.
    """
    arrays = unpack(data, what, _LABEL_SHAPES)
    if arrays["count"].sum() != len(arrays["score"]):
        raise InvalidInputError(f"{what} holds {len(arrays['score'])} grasps and counts {arrays['count'].sum()}")
    # Rounding may move a rotation at the border of the canonical form to its other side.
    rotation, contacts = canonical_jaw(
        rotation_from_quaternion(arrays["quaternion"].astype(np.float64)), from_steps(arrays["contacts"], LENGTH_STEP)
    )
    every = GraspLabels(
        translation=from_steps(arrays["translation"], LENGTH_STEP),
        rotation=rotation.astype(np.float32),
        score=from_steps(arrays["score"], SCORE_STEP),
        contacts=contacts,
        entry=from_steps(arrays["entry"], LENGTH_STEP),
        object_index=arrays["object_index"].astype(np.int64),
    )
    ends = np.cumsum(arrays["count"])
    return [every[end - count : end] for end, count in zip(ends.tolist(), arrays["count"].tolist(), strict=True)]


def view_to_bytes(view: View, confidence: Array, window: tuple[slice, slice]) -> bytes:
    """What a camera saw in a window (rows, columns) of its image; confidence: (widths, H, W) of the whole image."""
    depth = to_steps(np.nan_to_num(view.depth[window], nan=0.0), DEPTH_STEP, np.uint16)
    return pack(
        {
            # Differences along rows are small numbers, which compress better.
            "depth": np.diff(depth, axis=1, prepend=depth.dtype.type(0)),
            "colours": view.colours[window],
            "object_index": _code(view.object_ids[window]),
            "confidence": to_steps(confidence[:, *window], CONFIDENCE_STEP, np.uint8),
        }
    )


def view_from_bytes(data: bytes, what: str = "the view") -> ViewData:
    """Reads what ``view_to_bytes`` wrote.

    Raises:
        InvalidInputError: it is damaged.
    """
    arrays = unpack(data, what, _VIEW_SHAPES)
    steps = np.cumsum(arrays["depth"], axis=1, dtype=np.uint16)
    depth = from_steps(steps, DEPTH_STEP)
    depth[steps == 0] = np.nan
    codes = arrays["object_index"]
    index = codes.astype(np.int16)
    for code, meaning in ((TABLE_CODE, -1), (FIXTURE_CODE, -2), (NOTHING_CODE, -3)):
        index[codes == code] = meaning
    return ViewData(depth, arrays["colours"], index, from_steps(arrays["confidence"], CONFIDENCE_STEP))


def _code(object_ids: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    codes = np.full(object_ids.shape, NOTHING_CODE, np.uint8)
    codes[object_ids == TABLE_ID] = TABLE_CODE
    codes[object_ids == FIXTURE_ID] = FIXTURE_CODE
    seen = object_ids >= 0
    codes[seen] = object_ids[seen].astype(np.uint8)
    return codes


def _box_to_list(box: Box) -> list[list[float]]:
    return [list(box.lower), list(box.upper)]


def _box_from_list(corners: Sequence[Sequence[float]]) -> Box:
    lower, upper = (tuple(corner) for corner in corners)
    return Box(lower, upper)  # type: ignore[arg-type]


def _view_to_dict(view: ViewInfo) -> dict[str, Any]:
    return {
        "sensor": view.sensor,
        "intrinsics": vars(view.camera.intrinsics),
        "T_world_camera": view.camera.T_world_camera.tolist(),
        "origin": view.origin,
    }


def _view_from_dict(document: Mapping[str, Any]) -> ViewInfo:
    row, column = document["origin"]
    camera = Camera(Intrinsics(**document["intrinsics"]), np.array(document["T_world_camera"]))
    return ViewInfo(str(document["sensor"]), camera, (int(row), int(column)))
