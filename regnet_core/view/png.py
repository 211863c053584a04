"""Pictures of detections as PNG files: one panel for each scene, with titles and a legend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from regnet_core.errors import InvalidInputError
from regnet_core.view.palette import SELECTED, Rgb, rank_colors
from regnet_core.view.render import RenderStyle, View, prepare_views, render_view
from regnet_core.view.scene import ViewScene

_INK, _FAINT, _PAPER, _LINE = (28, 33, 42), (98, 108, 124), (255, 255, 255), (214, 219, 228)
_HEADER, _FOOTER, _GAP, _RAMP = 64, 46, 10, 120


def render_png(
    path: str | Path,
    scenes: ViewScene | Sequence[ViewScene],
    *,
    panel_size: tuple[int, int] = (960, 760),
    style: RenderStyle | None = None,
    same_camera: bool = True,
) -> None:
    """Draw the scenes side by side into a PNG file; needs neither a GPU nor a display.

    Args:
        path: where to write.
        scenes: what to draw, one panel for each.
        panel_size: width and height of each panel's picture [pixels].
        style: how to draw.
        same_camera: take all the pictures from one place, for scenes that are to be compared.

    Raises:
        InvalidInputError: there is no scene, or the path does not end in .png.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise InvalidInputError(f"pictures are written as .png, got '{target.name}'")
    Image.fromarray(render_panels(scenes, panel_size=panel_size, style=style, same_camera=same_camera)).save(target)


def render_panels(
    scenes: ViewScene | Sequence[ViewScene],
    *,
    panel_size: tuple[int, int] = (960, 760),
    style: RenderStyle | None = None,
    same_camera: bool = True,
) -> npt.NDArray[np.uint8]:
    """The picture that ``render_png`` writes, as an array (H, W, 3)."""
    panels = [scenes] if isinstance(scenes, ViewScene) else list(scenes)
    if not panels:
        raise InvalidInputError("there is nothing to draw: no scene was given")
    style = style or RenderStyle()
    views = prepare_views(panels, panel_size, style, same_camera)
    columns = len(views) if len(views) <= 3 else math.ceil(math.sqrt(len(views)))
    rows = math.ceil(len(views) / columns)
    width, height = panel_size
    sheet = Image.new(
        "RGB",
        (columns * width + (columns + 1) * _GAP, rows * (height + _HEADER) + _FOOTER),
        _PAPER,
    )
    for number, view in enumerate(views):
        x = _GAP + (number % columns) * (width + _GAP)
        y = (number // columns) * (height + _HEADER)
        sheet.paste(Image.fromarray(render_view(view, style)), (x, y + _HEADER))
        _write_header(ImageDraw.Draw(sheet), view, x, y)
    _write_legend(ImageDraw.Draw(sheet), _GAP, sheet.height - _FOOTER, views)
    return np.asarray(sheet)


def _write_header(draw: ImageDraw.ImageDraw, view: View, x: int, y: int) -> None:
    draw.text((x + 4, y + 8), view.scene.title, _INK, _font(24))
    draw.text((x + 4, y + 38), view.scene.caption, _FAINT, _font(16))


def _write_legend(draw: ImageDraw.ImageDraw, x: int, y: int, views: Sequence[View]) -> None:
    middle, font = y + _FOOTER // 2, _font(16)
    shown = max(len(view.ranks) for view in views)
    if shown:
        x = _write(draw, x + 4, middle, "best", font)
        for i, color in enumerate(rank_colors(_RAMP)):
            draw.line([(x + i, middle - 6), (x + i, middle + 6)], _to_bytes(color))
        x = _write(draw, x + _RAMP + 8, middle, f"last of up to {shown} grasps drawn, one for each spot", font) + 28
    if any(view.scene.selected is not None for view in views):
        draw.rectangle([x, middle - 7, x + 18, middle + 7], _to_bytes(SELECTED))
        _write(draw, x + 26, middle, "selected grasp and its approach", font)


def _to_bytes(color: Rgb) -> tuple[int, int, int]:
    red, green, blue = (int(255 * c) for c in color)
    return red, green, blue


def _write(draw: ImageDraw.ImageDraw, x: int, middle: int, text: str, font: ImageFont.FreeTypeFont) -> int:
    draw.text((x, middle), text, _FAINT, font, anchor="lm")
    return x + int(draw.textlength(text, font)) + 8


def _font(size: int) -> ImageFont.FreeTypeFont:
    font = ImageFont.load_default(size)
    assert isinstance(font, ImageFont.FreeTypeFont)
    return font
