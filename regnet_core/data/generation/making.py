"""Makes one scene of a data set: objects drawn, dropped, seen by cameras, labelled, and coded as members of a tar."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from regnet_core.data.cameras.camera import KINECT_V2, PAPER_POSES, Camera, from_euler
from regnet_core.data.cameras.colour_noise import ColourNoise
from regnet_core.data.cameras.dome import dome_camera, dome_for
from regnet_core.data.cameras.rendering import SceneRenderer, View
from regnet_core.data.cameras.sensors import SENSORS
from regnet_core.data.generation.prepared import PreparedLibrary, PreparedObject, areas
from regnet_core.data.generation.settings import MOST_OBJECTS_IN_A_SCENE, GenerationSettings
from regnet_core.data.labels.confidence import grasp_weights, point_confidence
from regnet_core.data.labels.scene_labels import LabelledScene, SceneLabeller
from regnet_core.data.scenes.dropping import SceneError
from regnet_core.data.scenes.kinds import compose_scene, object_count
from regnet_core.data.scenes.scene import Scene, default_table
from regnet_core.data.storage.records import (
    SceneInfo,
    ViewInfo,
    info_to_bytes,
    labels_to_bytes,
    scene_key,
    view_to_bytes,
)
from regnet_core.data.storage.tars import write_tar
from regnet_core.errors import RegnetError
from regnet_core.geometry import Array, Box

REDRAWS = 20
"""How often a scene that does not come to rest is drawn anew, with other objects."""
REACH = 0.42
"""Half the side of the square on the table that views keep [m]."""
BELOW, ABOVE = 0.07, 0.5
"""How far below and above the table's top views keep points [m]."""
COLOUR_NOISE = ColourNoise(pixel=4.0, brightness=0.15, white_balance=0.05)
_DOMAIN = 0x5CE7E
"""Sets the random numbers of scenes apart from those of the object library."""
_SPLIT_CODE = {"train": 0, "val": 1, "test": 2}


class GenerationError(RegnetError):
    """A scene could not be made."""


def workspace(table: Box) -> Box:
    """What views keep: the middle of the table and everything on it [m]."""
    x, y = (0.5 * (table.lower[i] + table.upper[i]) for i in range(2))
    top = table.upper[2]
    return Box((x - REACH, y - REACH, top - BELOW), (x + REACH, y + REACH, top + ABOVE))


def make_scene_tar(index: int, settings: GenerationSettings, names: Sequence[str], library: PreparedLibrary) -> bytes:
    """The tar archive of scene number ``index``; it depends on nothing but the arguments.

    Args:
        index: number of the scene.
        settings: of the data set.
        names: all objects of the library, in its order.
        library: the objects themselves.

    Raises:
        GenerationError: no draw came to rest.
    """
    for redraw in range(REDRAWS):
        rng = np.random.default_rng([_DOMAIN, settings.seed, _SPLIT_CODE[settings.split], index, redraw])
        kind = _draw_kind(settings, rng)
        count = min(object_count(kind, rng), len(names), MOST_OBJECTS_IN_A_SCENE)
        objects = [library[names[i]] for i in rng.choice(len(names), count, replace=False)]
        try:
            scene = compose_scene(kind, [one.model for one in objects], rng)
        except SceneError:
            continue
        return _encode(index, kind, scene, objects, settings, rng, redraw)
    raise GenerationError(
        f"scene {index} of seed {settings.seed} did not come to rest in {REDRAWS} draws; choose another seed, other "
        "kinds of scenes (--kind), or objects that can lie still"
    )


def _draw_kind(settings: GenerationSettings, rng: np.random.Generator) -> str:
    kinds, shares = zip(*settings.kinds, strict=True)
    return str(rng.choice(kinds, p=np.array(shares, float) / sum(shares)))


def _encode(
    index: int,
    kind: str,
    scene: Scene,
    objects: Sequence[PreparedObject],
    settings: GenerationSettings,
    rng: np.random.Generator,
    redraws: int,
) -> bytes:
    labels = label_scene(scene, objects, settings, rng)
    weights = grasp_weights(areas(objects), settings.candidates.points, settings.confidence_gain)
    renderer = SceneRenderer(scene)
    members, infos = [], []
    for number, (sensor, camera) in enumerate(draw_cameras(settings, rng)):
        noise = SENSORS[sensor].noise
        view = renderer.render(camera, noise, rng, region=workspace(scene.table), colour_noise=COLOUR_NOISE)
        window = _window(view)
        confidence = view_confidence(view, labels, weights)
        infos.append(ViewInfo(sensor, camera, (window[0].start, window[1].start)))
        members.append((f"{scene_key(index)}.view{number}.st.zst", view_to_bytes(view, confidence, window)))
    info = SceneInfo(
        index,
        kind,
        tuple(model.name for model in scene.objects),
        scene.poses,
        scene.table,
        scene.fixtures,
        tuple(infos),
        settings.widths,
        tuple(one.found for one in labels),
        redraws,
    )
    return write_tar(
        [
            (f"{scene_key(index)}.json", info_to_bytes(info)),
            (f"{scene_key(index)}.grasps.st.zst", labels_to_bytes([one.kept for one in labels])),
            *members,
        ]
    )


def label_scene(
    scene: Scene, objects: Sequence[PreparedObject], settings: GenerationSettings, rng: np.random.Generator
) -> list[LabelledScene]:
    """The labels of every width; ``objects`` are the scene's, in its order."""
    labeller = SceneLabeller(scene, settings.labels, [one.tree for one in objects])
    return [
        labeller.label([one.candidates[w] for one in objects], gripper, rng)
        for w, gripper in enumerate(settings.grippers)
    ]


def draw_cameras(settings: GenerationSettings, rng: np.random.Generator) -> list[tuple[str, Camera]]:
    """Names of sensors and cameras of a scene: some of the paper's poses, then random ones on a dome."""
    chosen = rng.choice(len(PAPER_POSES), settings.paper_views, replace=False)
    cameras = [("kinect_v2", Camera(KINECT_V2, from_euler(*PAPER_POSES[i]))) for i in np.sort(chosen)]
    for _ in range(settings.dome_views):
        sensor = SENSORS[str(rng.choice(list(SENSORS)))]
        cameras.append((sensor.name, dome_camera(rng, sensor.intrinsics, default_table(), dome_for(sensor))))
    return cameras


def view_confidence(view: View, labels: Sequence[LabelledScene], weights: Array) -> npt.NDArray[np.float64]:
    """(widths, H, W) point grasp confidence; only points of objects have any.

    Args:
        view: what a camera saw.
        labels: of each width.
        weights: (K,) of the objects' grasps.
    """
    seen = np.isfinite(view.depth) & (view.object_ids >= 0)
    points = view.world_points()[seen]
    confidence = np.zeros((len(labels), *view.depth.shape))
    for w, one in enumerate(labels):
        best = one.best
        confidence[w][seen] = point_confidence(points, best.entry_points, best.score * weights[best.object_index])
    return confidence


def _window(view: View) -> tuple[slice, slice]:
    """Rows and columns that hold all points of the view; one pixel where there are none."""
    rows, columns = (np.flatnonzero(np.isfinite(view.depth).any(axis=axis)) for axis in (1, 0))
    if len(rows) == 0:
        return slice(0, 1), slice(0, 1)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
