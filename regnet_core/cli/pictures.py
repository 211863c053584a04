"""The pictures of ``regnet detect --view``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from regnet_core.cli.results import Result, make_folder
from regnet_core.errors import InvalidInputError

if TYPE_CHECKING:
    from regnet_core.view import ViewScene

VIEW_SUFFIXES = (".html", ".png")
MAX_SCENES = 6
"""More results than this are not drawn."""


def check_view(path: Path) -> None:
    """Raise InvalidInputError where ``write_views`` could not write; make the folder."""
    if path.suffix not in VIEW_SUFFIXES:
        raise InvalidInputError(f"--view must end in {' or '.join(VIEW_SUFFIXES)}, got '{path.name}'")
    make_folder(path, "--view")


def as_scene(result: Result) -> ViewScene:
    """The result as it is to be drawn."""
    from regnet_core.view import ViewScene

    detection, selection, source = result.detection, result.selection, result.source
    caption = detection.report.reason
    if selection is not None:
        quality = detection.grasps.quality[selection.rank]
        report = detection.report
        caption = (
            f"{len(detection.grasps)} grasps by {report.model} in {1000 * report.total_seconds:.0f} ms; "
            f"selected by the {result.policy} policy: rank {selection.rank}, quality {quality:.2f}"
        )
    return ViewScene.of_detection(
        detection,
        source.points,
        source.colors,
        selected=None if selection is None else selection.rank,
        title=f"{source.name}, gripper width {1000 * detection.gripper.width:.0f} mm",
        caption=caption,
        viewpoint=source.viewpoint,
    )


def write_views(path: Path, scenes: Sequence[ViewScene]) -> list[Path]:
    """Write NAME.html and NAME.png, or NAME.png alone, and return what was written."""
    from regnet_core.view import render_png, write_html

    picture = path.with_suffix(".png")
    written = [picture]
    if path.suffix == ".html":
        write_html(path, scenes)
        written.insert(0, path)
    render_png(picture, scenes, same_camera=all(scene.points is scenes[0].points for scene in scenes))
    return written
