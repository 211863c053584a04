"""Makes the recordings in bags/: scenes dropped in physics, seen by noisy depth cameras, written as MCAP bags.

    python tools/make_bags.py [--out bags] [--only NAME]

Every number comes from the seeds below: the same versions of the libraries give the same points. Beside each bag lie
the true meshes (scene.glb, world frame, z up) and how it was made (scene.json).
"""

import argparse
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from regnet_core.data.bags import POINTS_TOPIC, CloudBagWriter
from regnet_core.data.cameras.camera import KINECT_V2, Camera, look_at, paper_cameras
from regnet_core.data.cameras.noise import DepthNoise
from regnet_core.data.cameras.rendering import SceneRenderer, View
from regnet_core.data.objects.models import FAMILIES as OBJECT_FAMILIES
from regnet_core.data.objects.models import sample_object
from regnet_core.data.scenes.dropping import drop
from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Box, pose_matrix

START = 1_700_000_000_000_000_000
"""Stamp of the first message [ns]."""
PERIOD = 500_000_000
"""2 Hz [ns]."""
GRID = 2.0**-13
"""World coordinates are rounded to this [m], far below the 1 mm steps of the depth, so that the files compress well."""
AROUND_TABLE = Box((-0.42, -0.42, 0.68), (0.42, 0.42, 1.25))
"""What the clouds in the world frame keep: the middle of the table and everything on it [m]."""
OPTICAL_FRAME = "camera_depth_optical_frame"


RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "box": {"x": (0.02, 0.065), "y": (0.03, 0.12), "z": (0.03, 0.18)},
    "cylinder": {"radius": (0.011, 0.033), "height": (0.04, 0.18)},
    "can": {"radius": (0.025, 0.034), "height": (0.06, 0.14), "chamfer": (0.003, 0.006)},
    "bottle": {"radius": (0.02, 0.034), "height": (0.12, 0.24), "neck": (0.3, 0.5), "shoulder": (0.5, 0.75)},
    "cup": {
        "radius": (0.03, 0.045),
        "height": (0.07, 0.11),
        "taper": (0.75, 1.0),
        "wall": (0.003, 0.005),
        "handle": (0.004, 0.006),
    },
    "bowl": {"radius": (0.045, 0.075), "depth": (0.45, 0.75), "wall": (0.004, 0.007)},
    "hammer": {"length": (0.16, 0.25), "handle": (0.01, 0.015), "head": (0.07, 0.11), "head_radius": (0.012, 0.018)},
    "screwdriver": {
        "length": (0.14, 0.24),
        "handle": (0.011, 0.017),
        "handle_share": (0.4, 0.5),
        "shaft": (0.003, 0.005),
    },
    "banana": {"length": (0.13, 0.2), "radius": (0.014, 0.021), "bend": (0.8, 1.6)},
    "ring": {"radius": (0.025, 0.06), "tube": (0.007, 0.014)},
    "l_profile": {
        "long_leg": (0.06, 0.14),
        "short_leg": (0.04, 0.09),
        "thickness": (0.012, 0.03),
        "width": (0.02, 0.05),
    },
    "t_profile": {"bar": (0.06, 0.14), "stem": (0.04, 0.1), "thickness": (0.012, 0.03), "width": (0.02, 0.05)},
    "superquadric": {"x": (0.018, 0.033), "y": (0.02, 0.05), "z": (0.025, 0.06), "e1": (0.3, 1.2), "e2": (0.3, 1.2)},
    "blob": {
        "radius": (0.022, 0.031),
        "stretch": (1.0, 1.8),
        "bump": (0.05, 0.16),
        "a": (-1.0, 1.0),
        "b": (-1.0, 1.0),
        "c": (-1.0, 1.0),
        "d": (-1.0, 1.0),
    },
}
"""The families that the recordings hold and their parameters, made for a hand that opens 8 cm."""
FAMILIES = {name: replace(OBJECT_FAMILIES[name], ranges=ranges) for name, ranges in RANGES.items()}


@dataclass(frozen=True)
class Recipe:
    """One bag.

    Attributes:
        seed: of the scene and of the cameras' noise.
        objects: number of objects.
        families: their families, drawn when None.
        tilted: one organised depth-only view in its optical frame instead of four coloured clouds in the world.
    """

    seed: int
    objects: int
    families: tuple[str, ...] | None = None
    tilted: bool = False


RECIPES = {
    "one_object": Recipe(seed=1, objects=1, families=("bottle",)),
    "clutter_10": Recipe(seed=10, objects=10),
    "clutter_20": Recipe(seed=20, objects=20),
    "empty_table": Recipe(seed=0, objects=0),
    "tilted_depth_only": Recipe(seed=8, objects=8, tilted=True),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bags"), help="folder of the bags (default: bags)")
    parser.add_argument("--only", choices=sorted(RECIPES), help="make this bag alone")
    arguments = parser.parse_args()
    for name, recipe in RECIPES.items():
        if arguments.only in (None, name):
            folder = make_bag(arguments.out / name, recipe)
            size = sum(file.stat().st_size for file in folder.iterdir())
            print(f"{folder}: {size / 1e6:.2f} MB")


def make_bag(folder: Path, recipe: Recipe) -> Path:
    """Writes the bag and its ground truth into `folder`, which is replaced."""
    rng = np.random.default_rng(recipe.seed)
    scene = dropped_scene(recipe, rng)
    renderer = SceneRenderer(scene)
    cameras = (tilted_camera(),) if recipe.tilted else paper_cameras()
    views = [renderer.render(camera, DepthNoise(), rng) for camera in cameras]
    shutil.rmtree(folder, ignore_errors=True)
    with CloudBagWriter(folder) as bag:
        (write_tilted if recipe.tilted else write_world)(bag, views)
    scene.save(folder / "scene.glb")
    lines = [
        f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in describe(folder.name, recipe, scene, cameras)
    ]
    (folder / "scene.json").write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    return folder


def dropped_scene(recipe: Recipe, rng: np.random.Generator) -> Scene:
    """The objects of a recipe at rest on the table."""
    families = recipe.families or (None,) * recipe.objects
    models = [sample_object(rng, family, families=FAMILIES) for family in families]
    # In physics their parts are CoACD's, not those by construction, as they were when the recordings were made.
    named = [replace(m, name=f"{i:02d}_{m.family}", parts=None) for i, m in enumerate(models)]
    return drop(named, rng)


def tilted_camera() -> Camera:
    """A camera at the table's corner, held level and looking down at its middle."""
    return Camera(KINECT_V2, look_at((0.62, -0.42, 1.35), (0.0, 0.0, 0.78)))


def write_world(bag: CloudBagWriter, views: list[View]) -> None:
    """One coloured unorganised cloud per view, in the world frame."""
    frames = [f"camera_{i}_depth_optical_frame" for i in range(len(views))]
    bag.write_static_transforms(
        START, [("world", frame, view.camera.T_world_camera) for frame, view in zip(frames, views, strict=True)]
    )
    for i, (frame, view) in enumerate(zip(frames, views, strict=True)):
        points, colours = cloud_around_table(view)
        bag.write_camera_info(START + i * PERIOD, frame, view.camera.intrinsics)
        bag.write_cloud(START + i * PERIOD, "world", points, colours)


def cloud_around_table(view: View) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """(N, 3) points in the world and (N, 3) colours of what lies around the table."""
    points = view.world_points().reshape(-1, 3)
    keep = np.isfinite(points).all(axis=1) & AROUND_TABLE.contains(points)
    return GRID * np.round(points[keep] / GRID), view.colours.reshape(-1, 3)[keep]


def write_tilted(bag: CloudBagWriter, views: list[View]) -> None:
    """One organised cloud without colours in the optical frame, and the two transforms that place it in the world."""
    view = views[0]
    T_link_optical = pose_matrix((0.0, 0.0, 0.0), (-0.5 * np.pi, 0.0, -0.5 * np.pi))
    T_world_link = view.camera.T_world_camera @ np.linalg.inv(T_link_optical)
    bag.write_static_transforms(
        START, [("world", "camera_link", T_world_link), ("camera_link", OPTICAL_FRAME, T_link_optical)]
    )
    bag.write_camera_info(START, OPTICAL_FRAME, view.camera.intrinsics)
    bag.write_cloud(START, OPTICAL_FRAME, view.points())


def describe(name: str, recipe: Recipe, scene: Scene, cameras: tuple[Camera, ...]) -> list[tuple[str, object]]:
    """The entries of scene.json."""
    entries: list[tuple[str, object]] = [
        ("made_by", f"python tools/make_bags.py --only {name}"),
        ("seed", recipe.seed),
        ("points_topic", POINTS_TOPIC),
        ("points_frame", OPTICAL_FRAME if recipe.tilted else "world"),
        ("table_height", scene.table_height),
        ("table", {"lower": scene.table.lower, "upper": scene.table.upper}),
        ("objects", [model.name for model in scene.objects]),
        ("stamps_ns", [START + i * PERIOD for i in range(len(cameras))]),
        ("T_world_camera", [np.round(camera.T_world_camera, 9).tolist() for camera in cameras]),
    ]
    if recipe.tilted:
        T = cameras[0].T_world_camera
        rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
        pose = {"frame": OPTICAL_FRAME, "target_frame": "world", "xyz": np.round(T[:3, 3], 9).tolist()}
        entries.append(("sensor_pose", {**pose, "rpy": np.round(rpy, 9).tolist()}))
    return entries


if __name__ == "__main__":
    main()
