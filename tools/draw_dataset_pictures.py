"""Draws docs/dataset_scenes.png and docs/dataset_noise.png: the kinds of scenes and the noise of the sensors.

python tools/draw_dataset_pictures.py [--out docs]
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from regnet_core.data.cameras.camera import Camera, Intrinsics, look_at
from regnet_core.data.cameras.rendering import SceneRenderer, View
from regnet_core.data.cameras.sensors import SENSORS, Sensor
from regnet_core.data.objects.models import ObjectModel, sample_object
from regnet_core.data.scenes.kinds import SCENE_KINDS, compose_scene
from regnet_core.data.scenes.scene import Scene
from regnet_core.geometry import Box

TITLES = {
    "pile": "pile: dropped on each other",
    "single": "single: dropped or standing",
    "packed": "packed: upright, 1 to 4 cm apart",
    "bin": "bin: dropped into an open box",
}
FAMILIES = {
    "pile": (
        "box",
        "bottle",
        "banana",
        "cup",
        "hammer",
        "can",
        "ring",
        "bowl",
        "l_profile",
        "screwdriver",
        "blob",
        "cup",
    ),
    "single": ("cup",),
    "packed": ("bottle", "box", "can", "cup", "cylinder", "bottle", "box", "bowl"),
    "bin": ("box", "can", "ring", "t_profile", "banana", "cylinder", "superquadric", "box", "blob", "screwdriver"),
}
SEEDS = {"pile": 11, "single": 3, "packed": 5, "bin": 4}
NAMES = {
    "kinect_v2": "Kinect v2\ntime of flight",
    "kinect_v1": "Kinect v1\nstructured light",
    "realsense_d435": "RealSense D435\nstereo",
}
FOCAL = {"pile": 1280.0, "single": 2900.0, "packed": 1450.0, "bin": 1330.0}
"""Focal lengths of the pictures of scenes [pixel]."""
EYE = (0.55, -0.5, 1.45)
"""Camera of the pictures of scenes [m]."""
OBSERVER = (0.1, -0.62, 1.45)
"""Depth cameras of the pictures of noise [m]."""
SHOWN = Box((-0.2, -0.19, 0.72), (0.21, 0.2, 0.95))
"""What the pictures of noise show [m]."""
SLICE = 0.004
"""Half the thickness of the profiles [m]."""
ERROR = 15.0
"""End of the scale of errors [mm]."""
LOST = "#20242b"


def main() -> None:
    """Draw both pictures and write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder of the pictures (default: docs)")
    out = parser.parse_args().out
    plt.rcParams.update({"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11})
    draw_scenes().savefig(out / "dataset_scenes.png", dpi=110)
    draw_noise().savefig(out / "dataset_noise.png", dpi=100)


def draw_scenes() -> Figure:
    """One scene of each kind in colours."""
    figure, axes = plt.subplots(2, 2, figsize=(8.6, 6.6), layout="constrained")
    for axis, kind in zip(axes.ravel(), SCENE_KINDS, strict=True):
        axis.imshow(photograph(make_scene(kind), FOCAL[kind]), interpolation="antialiased")
        axis.set_title(TITLES[kind])
        axis.axis("off")
    return figure


def make_scene(kind: str) -> Scene:
    """The kind's scene of this picture."""
    rng = np.random.default_rng(SEEDS[kind])
    models: list[ObjectModel] = [sample_object(rng, family, f"{i}_{family}") for i, family in enumerate(FAMILIES[kind])]
    return compose_scene(kind, models, rng)


def photograph(scene: Scene, focal: float) -> NDArray[np.uint8]:
    """Colours (H, W, 3) from a camera with a focal length [pixel]; nothing is white."""
    middle = scene.poses[:, :3, 3].mean(axis=0)
    camera = Camera(Intrinsics(1000, 720, focal, focal, 499.5, 359.5), look_at(EYE, middle))
    view = SceneRenderer(scene, floor=False).render(camera)
    return np.where(np.isfinite(view.depth)[..., None], view.colours, 255).astype(np.uint8)


def draw_noise() -> Figure:
    """Depth, error and a profile of one scene, one row for each sensor."""
    figure, axes = plt.subplots(
        len(SENSORS), 3, figsize=(10.6, 8.0), layout="constrained", width_ratios=(1.0, 1.0, 1.2)
    )
    renderer = SceneRenderer(make_scene("packed"))
    for row, sensor in zip(axes, SENSORS.values(), strict=True):
        draw_sensor(row, renderer, sensor)
    axes[0, 0].set_title("depth")
    axes[0, 1].set_title("error, as reported less true")
    axes[0, 2].set_title("an 8 mm slice from the side; true: grey")
    for axis in axes[:-1, 2]:
        axis.set_xlabel("")
        axis.set_xticklabels([])
    return figure


def draw_sensor(row: NDArray[np.object_], renderer: SceneRenderer, sensor: Sensor) -> None:
    """Fills one row of axes."""
    camera = Camera(sensor.intrinsics, look_at(OBSERVER, (0.0, 0.0, 0.8)))
    window = camera.window(SHOWN).slices
    exact = renderer.render(camera)
    noisy = renderer.render(camera, sensor.noise, np.random.default_rng(0))
    depth = show(row[0], noisy.depth[window], plt.get_cmap("viridis_r", 40), (0.7, 1.1))
    depth.set_label("m")
    error = 1000.0 * (noisy.depth - exact.depth)[window]
    bar = show(row[1], error, plt.get_cmap("RdBu", 15), (-ERROR, ERROR))
    bar.set_label("mm")
    row[0].set_ylabel(NAMES[sensor.name], fontsize=11)
    draw_profile(row[2], exact, noisy)


def show(axis: Axes, image: NDArray[np.float64], colours: Colormap, limits: tuple[float, float]) -> Colorbar:
    """An image with a colour bar; pixels without a return are dark. Few colours keep the file small."""
    colours = colours.with_extremes(bad=LOST)
    shown = axis.imshow(
        np.ma.masked_invalid(image), cmap=colours, vmin=limits[0], vmax=limits[1], interpolation="nearest"
    )
    axis.set_xticks([])
    axis.set_yticks([])
    return plt.colorbar(shown, ax=axis, shrink=0.85, pad=0.02)


def draw_profile(axis: Axes, exact: View, noisy: View) -> None:
    """Points near the plane x = 0 of the world: the true ones in grey, the reported ones on top."""
    for view, colour, size in ((exact, "#b9c0ca", 16.0), (noisy, "#c0392b", 3.0)):
        points, _ = view.cloud()
        near = points[(np.abs(points[:, 0]) < SLICE) & SHOWN.contains(points)]
        axis.scatter(100.0 * near[:, 1], 100.0 * (near[:, 2] - 0.75), s=size, color=colour, linewidths=0.0)
    axis.set_aspect("equal")
    axis.set_xlim(-18.0, 12.0)
    axis.set_ylim(-3.0, 18.0)
    axis.set_xlabel("away from the camera [cm]")
    axis.set_ylabel("above the table [cm]")
    axis.grid(color="#e6e9ee", linewidth=0.6)
    axis.set_axisbelow(True)


if __name__ == "__main__":
    main()
