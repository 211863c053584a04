"""Watching an attempt of a recorded episode: it is done once more, and drawn as a strip of moments or as a film."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from regnet_core.errors import InvalidInputError
from regnet_core.geometry import Array, Box
from regnet_core.gripper import Gripper
from regnet_core.picking.pictures import Stage
from regnet_core.picking.records import recorded_grasp, recorded_state
from regnet_core.picking.robot import PickAttempt, PickRobot
from regnet_core.picking.scenes import make_scene, pick_scene
from regnet_core.picking.study import EpisodeStore, Job, PickSettings, pick_robot
from regnet_core.picking.workcell import Workcell
from regnet_core.sim.outcome import Recording
from regnet_core.sim.transfer import GIVEN_UP, LOST

RECORD_EVERY = 0.02
"""Interval of what is recorded of an attempt that is watched [s]."""
_PANEL = (440, 400)
"""Width and height of a picture of a strip [pixels]."""
_COLUMNS = 4
"""Most panels in a row of a strip."""
_LEAST_WIDTH = 3 * _PANEL[0]
"""Of a strip, for the words below it [pixels]."""
_FILM = (560, 420)
_FILM_STEP = 0.08
"""Simulated time between two pictures of a film, which runs as fast as the simulation [s]."""
_LAST_PICTURE = 1.5
"""How long a film stands still at its end [s]."""
_HEADER, _FOOTER, _GAP = 34, 58, 8
_INK, _FAINT, _GOOD, _BAD = (28, 33, 42), (98, 108, 124), (38, 130, 66), (190, 45, 40)
_CLOSE = 0.13
"""Half the side of the surroundings that are shown of a grasp [m]."""


class Watched:
    """An attempt that was done once more."""

    def __init__(self, settings: PickSettings, job: Job, record: dict[str, Any], number: int) -> None:
        """Args:
            settings: of the study.
            job: the episode.
            record: what `EpisodeStore.read` gave for it.
            number: of the attempt, from 0.

        Raises:
            InvalidInputError: there is no such attempt, or the scene is not the one that was recorded.
        """
        attempts = record["attempts"]
        if not 0 <= number < len(attempts):
            raise InvalidInputError(
                f"episode {job.episode} has {len(attempts)} attempts, counted from 0, and none with number {number}"
            )
        self.scene = make_scene(job.cell.scene, settings.seed, job.episode)
        if [model.name for model in self.scene.objects] != record["objects"]:
            raise InvalidInputError(f"episode {job.episode} was recorded with other objects than there are now")
        self.job, self.number, self.recorded = job, number, attempts[number]
        self.cell: Workcell = pick_scene(job.cell.scene).workcell
        self.gripper = Gripper(width=settings.width)
        self.grasp = recorded_grasp(self.recorded)
        self.before = recorded_state(self.recorded["before"])
        robot: PickRobot = pick_robot(settings, job)
        self.attempt: PickAttempt = robot.try_grasp(self.before, self.grasp, RECORD_EVERY)

    @property
    def recording(self) -> Recording:
        """The state at short intervals."""
        recording = self.attempt.record.recording
        assert recording is not None  # it was asked for
        return recording

    def frame(self, time: float) -> int:
        """Index of the recorded state nearest to a time [s]."""
        return int(np.abs(self.recording.time - time).argmin())


def watch(settings: PickSettings, folder: Path, job: Job, number: int) -> Watched:
    """Does an attempt of a finished episode once more.

    Raises:
        InvalidInputError: the episode is not there, or has no such attempt.
    """
    return Watched(settings, job, EpisodeStore(folder, settings).read(job), number)


def strip(watched: Watched) -> npt.NDArray[np.uint8]:
    """The moments of an attempt, in rows of up to four, with what came of it (H, W, 3)."""
    stage, recording = Stage(watched.scene, watched.gripper), watched.recording
    panels = []
    for moment, time in watched.attempt.record.moments.items():
        at = watched.frame(time)
        poses, hand, opening = recording.object_poses[at], recording.hand_poses[at], float(recording.opening[at])
        image = stage.draw(poses, hand, opening, _surroundings(watched, moment, hand), _PANEL)
        panels.append((f"{moment}, {time:.2f} s", image))
    final = stage.draw(_final_poses(watched), None, 0.0, _both_bins(watched.cell), _PANEL)
    panels.append(("all at rest", final))
    rows = -(-len(panels) // _COLUMNS)
    columns = -(-len(panels) // rows)
    width, height = columns * (_PANEL[0] + _GAP) + _GAP, rows * (_HEADER + _PANEL[1]) + _FOOTER
    sheet = Image.new("RGB", (max(width, _LEAST_WIDTH), height), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for i, (title, image) in enumerate(panels):
        x, y = _GAP + i % columns * (_PANEL[0] + _GAP), i // columns * (_HEADER + _PANEL[1])
        sheet.paste(Image.fromarray(image), (x, y + _HEADER))
        draw.text((x + 2, y + 8), title, _INK, _font(17))
    _write_verdict(draw, watched, _GAP, height - _FOOTER + 8)
    return np.asarray(sheet)


def write_film(path: Path, watched: Watched) -> None:
    """Writes the attempt as an animated GIF, in the time of the simulation."""
    stage, recording = Stage(watched.scene, watched.gripper), watched.recording
    stride = max(1, round(_FILM_STEP / RECORD_EVERY))
    frame = _both_bins(watched.cell)
    pictures = [
        stage.draw(
            recording.object_poses[i],
            recording.hand_poses[i],
            float(recording.opening[i]),
            frame,
            _FILM,
            supersampling=1,
        )
        for i in range(0, len(recording.time), stride)
    ]
    pictures.append(stage.draw(_final_poses(watched), None, 0.0, frame, _FILM, supersampling=1))
    images = [_with_verdict(picture, watched) for picture in pictures]
    step = round(1000 * stride * RECORD_EVERY)
    durations = [*[step] * (len(images) - 1), round(1000 * _LAST_PICTURE)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True)


def _with_verdict(picture: npt.NDArray[np.uint8], watched: Watched) -> Image.Image:
    """A picture of the film with a line below it."""
    sheet = Image.new("RGB", (picture.shape[1], picture.shape[0] + _FOOTER), (255, 255, 255))
    sheet.paste(Image.fromarray(picture), (0, 0))
    _write_verdict(ImageDraw.Draw(sheet), watched, 6, picture.shape[0] + 6, small=True)
    return sheet.quantize(128)


def _write_verdict(draw: ImageDraw.ImageDraw, watched: Watched, x: int, y: int, small: bool = False) -> None:
    verdict, job = watched.attempt.verdict, watched.job
    outcome = "placed" if verdict.failure is None else verdict.failure.value
    large, fine = (14, 11) if small else (20, 16)
    head = f"episode {job.episode}, attempt {watched.number}: "
    draw.text((x, y), head, _INK, _font(large))
    start = x + int(draw.textlength(head, _font(large)))
    draw.text((start, y), outcome, _BAD if verdict.failure else _GOOD, _font(large))
    draw.text((x, y + large + 8), verdict.message, _FAINT, _font(fine))


def _surroundings(watched: Watched, moment: str, hand: Array) -> Sequence[Box]:
    """What a picture of a moment shows: the place of the grasp, the lift, or the place bin."""
    around = _around(watched.grasp.fingertips(watched.gripper)[0], _CLOSE)
    if moment in ("before", "at the grasp", "closed", GIVEN_UP):
        return (around,)
    if moment in ("lifted", LOST):
        return (around, _around(hand[:3, 3], 0.08))
    return (watched.cell.place_bin.inside, _around(hand[:3, 3], 0.05))


def _around(point: Array, reach: float) -> Box:
    return Box(tuple(point - reach), tuple(point + reach))


def _both_bins(cell: Workcell) -> Sequence[Box]:
    """The source and the place bin, with the room above them that the hand needs."""
    (x0, y0, z0), (x1, y1, _) = cell.source.lower, cell.source.upper
    return (Box((x0, y0, z0), (x1, y1, z0 + 0.45)), cell.place_bin.inside)


def _final_poses(watched: Watched) -> Array:
    """Where everything came to rest (K, 4, 4); what was placed is shown as it fell, before it was taken away."""
    poses = watched.attempt.after.poses()
    placed = list(watched.attempt.placed)
    if placed and len(watched.recording.time):
        poses[placed] = watched.recording.object_poses[-1][placed]
    return poses


def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font
