"""``regnet detect``: grasps in the clouds of files and bags."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress

from regnet_core.cli import options as opt
from regnet_core.cli.inputs import CloudInput, InputOptions, check_inputs, read_inputs
from regnet_core.cli.pictures import MAX_SCENES, as_scene, check_view, write_views
from regnet_core.cli.results import Result, as_document, as_record, check_out, write_results
from regnet_core.cli.tables import make_console, print_result
from regnet_core.detector import Detection, GraspDetector
from regnet_core.errors import InvalidInputError
from regnet_core.filters import GraspFilters
from regnet_core.geometry import Box
from regnet_core.gripper import Gripper
from regnet_core.models import DEFAULT_MODEL
from regnet_core.policy import Policy, make_policy

if TYPE_CHECKING:
    from regnet_core.view.scene import ViewScene

NO_GRASP = 3
EXIT_CODES = (
    "Exit codes: 0 grasps were found (in at least one cloud and width); 3 the input is valid, but no grasp was found; "
    "2 wrong usage or unusable input (one line on stderr says what); 1 internal error."
)
_HAND = Gripper()


@dataclass(frozen=True)
class Presentation:
    """What becomes of the results."""

    top: int
    out: Path | None
    view: Path | None
    quiet: bool
    as_json: bool


@dataclass(frozen=True)
class _Job:
    """What is done with each cloud."""

    detector: GraspDetector
    policy: Policy
    grippers: list[Gripper]
    filters: GraspFilters

    def detect(self, cloud: CloudInput, gripper: Gripper) -> Result:
        detection = self.detector.detect(
            cloud.points, gripper, cloud.colors, filters=self.filters, viewpoint=cloud.viewpoint
        )
        return Result.of(cloud, detection, self.policy)


@dataclass
class _Collected:
    """What is kept of the results until the end."""

    records: list[dict[str, Any]] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)
    """The last one."""
    scenes: list[ViewScene] = field(default_factory=list)
    found: bool = False


def detect(
    files: opt.Files,
    gripper_width: opt.Widths = None,
    gripper_depth: opt.Depth = _HAND.depth,
    gripper_height: opt.Height = _HAND.height,
    gripper_thickness: opt.Thickness = _HAND.thickness,
    gripper_palm_depth: opt.PalmDepth = _HAND.palm_depth,
    model: opt.Model = DEFAULT_MODEL,
    device: opt.Device = "auto",
    seed: opt.Seed = 0,
    policy: opt.PolicyName = "heuristic",
    topic: opt.Topic = None,
    message: opt.MessageNumber = None,
    all_messages: opt.AllMessages = False,
    sensor_pose: opt.SensorPose = None,
    viewpoint: opt.Viewpoint = None,
    crop: opt.Crop = None,
    target: opt.Target = None,
    min_quality: opt.MinQuality = 0.0,
    approach_angle: opt.ApproachAngle = 180.0,
    top: opt.Top = 10,
    out: opt.Out = None,
    view: opt.ViewFile = None,
    quiet: opt.Quiet = False,
    as_json: opt.AsJson = False,
) -> None:
    """Find grasps in point clouds: ranked, free of collisions with what the camera saw, and one selected.

    Lengths are in metres. Ranks count from 0, the best.
    """
    hand = Gripper(_HAND.width, gripper_depth, gripper_height, gripper_thickness, gripper_palm_depth)
    grippers = [hand.replace(width=width) for width in gripper_width or [_HAND.width]]
    filters = GraspFilters(
        approach_max_angle=_radians(approach_angle), min_quality=min_quality, target=_box("--target", target)
    )
    inputs = InputOptions(topic, message, all_messages, sensor_pose, viewpoint, _box("--crop", crop))
    presentation, chosen = Presentation(top, out, view, quiet, as_json), make_policy(policy)
    # A network takes seconds to load: what is wrong with the command line is said before that.
    total = check_inputs(files, inputs) * len(grippers)
    _check_outputs(presentation, total)
    job = _Job(GraspDetector(model, device, seed), chosen, grippers, filters)
    found = _run(job, files, inputs, presentation, total)
    if not found:
        raise typer.Exit(NO_GRASP)


def _check_outputs(presentation: Presentation, total: int) -> None:
    if presentation.out is not None:
        check_out(presentation.out, total)
    if presentation.view is not None:
        check_view(presentation.view)


def _run(job: _Job, files: Sequence[Path], inputs: InputOptions, presentation: Presentation, total: int) -> bool:
    """Detect in every cloud with every gripper, ``total`` times; whether any grasp was found."""
    collected, console, written = _Collected(), make_console(), list[Path]()
    with _progress(console, presentation) as progress:
        task = progress.add_task("detecting", total=total)
        for cloud in read_inputs(files, inputs):
            if cloud.warning:
                typer.echo(f"regnet: warning: {cloud.label}: {cloud.warning}", err=True)
            for gripper in job.grippers:
                _present(job.detect(cloud, gripper), presentation, collected, console)
                progress.advance(task)
        if presentation.view is not None:
            progress.update(task, description="drawing")
            written += _draw(presentation.view, collected.scenes, total)
    if presentation.as_json:
        typer.echo(json.dumps(as_document(collected.records)))
    if presentation.out is not None:
        write_results(presentation.out, collected.records, collected.detections)
        written.append(presentation.out)
    if not (presentation.quiet or presentation.as_json):
        for file in written:
            console.print(f"wrote {escape(str(file))}", soft_wrap=True)
    return collected.found


def _present(result: Result, presentation: Presentation, collected: _Collected, console: Console) -> None:
    """Print one result and keep what is needed of it at the end."""
    collected.found |= len(result.detection.grasps) > 0
    if not (presentation.quiet or presentation.as_json):
        print_result(console, result, presentation.top)
    if presentation.as_json or presentation.out is not None:
        collected.records.append(as_record(result))
        collected.detections = [result.detection]
    if presentation.view is not None and len(collected.scenes) < MAX_SCENES:
        collected.scenes.append(as_scene(result))


def _draw(path: Path, scenes: list[ViewScene], total: int) -> list[Path]:
    written = write_views(path, scenes)
    if total > len(scenes):
        typer.echo(f"regnet: warning: only the first {len(scenes)} of {total} results are drawn", err=True)
    return written


def _progress(console: Console, presentation: Presentation) -> Progress:
    """A bar that goes away in the end: above the tables' lines on a terminal, on stderr where stdout is redirected."""
    shared = console.is_terminal and not presentation.as_json
    shown_on = console if shared else Console(stderr=True)
    hidden = presentation.quiet or not shown_on.is_terminal
    return Progress(console=shown_on, transient=True, disable=hidden, redirect_stdout=False)


def _box(option: str, numbers: tuple[float, ...] | None) -> Box | None:
    if numbers is None:
        return None
    try:
        return Box(numbers[:3], numbers[3:])  # type: ignore[arg-type]
    except InvalidInputError as error:
        raise InvalidInputError(f"{option}: {error}") from error


def _radians(degrees: float) -> float:
    if not 0.0 < degrees <= 180.0:
        raise InvalidInputError(f"--approach-angle must be more than 0 and at most 180 degrees, got {degrees:g}")
    return math.radians(degrees)
