"""Draws docs/grasp_frame.png: the grasp frame and the gripper's dimensions, from the code's own boxes.

python tools/draw_grasp_frame.py [--out docs/grasp_frame.png]
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from regnet_core import Box, Gripper

BODY, REGION, X_AXIS, Y_AXIS, Z_AXIS = "#9aa4b2", "#bfe3c6", "#c0392b", "#2e8b57", "#2467b3"
MM = 1000.0


def main() -> None:
    """Draw both views and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/grasp_frame.png"))
    gripper = Gripper(width=0.08)
    figure, (top, side) = plt.subplots(1, 2, figsize=(12, 5.4), width_ratios=(1.25, 1), sharey=False)
    draw_view(top, gripper, 1)
    draw_view(side, gripper, 2)
    top.set_title("seen along -Z: fingers close along Y")
    side.set_title("seen along Y: the hand is H thick")
    dimension(top, (gripper.width / 2, 0.036), (-gripper.width / 2, 0.036), "W, opening", rotate=False)
    dimension(top, (-gripper.width / 2 - 0.018, 0.0), (-gripper.width / 2 - 0.018, gripper.depth), "D")
    dimension(top, (-gripper.width / 2 - 0.018, -gripper.palm_depth), (-gripper.width / 2 - 0.018, 0.0), "palm depth")
    dimension(top, (gripper.width / 2, 0.067), (gripper.width / 2 + gripper.thickness, 0.067), "T", rotate=False)
    dimension(side, (-gripper.height / 2, 0.067), (gripper.height / 2, 0.067), "H", rotate=False)
    top.annotate("closing region", (0.0, 0.051), ha="center", va="center", color="#21633a")
    top.annotate("palm", (0.0, -0.04), ha="center", va="center")
    figure.tight_layout()
    figure.savefig(parser.parse_args().out, dpi=110)


def draw_view(axes: Axes, gripper: Gripper, across: int) -> None:
    """The gripper's boxes with X up and axis ``across`` (1 = Y, 2 = Z) to the left, and the frame's axes."""
    palm, left, right = gripper.bodies()
    add_box(axes, gripper.closing_region(), across, REGION, "--")
    for body in (palm, left, right):
        add_box(axes, body, across, BODY, "-")
    other, colour = ("Y, closing", Y_AXIS) if across == 1 else ("Z = X x Y", Z_AXIS)
    arrow(axes, (0.0, 0.028), X_AXIS, "X, approach", (10, -12))
    arrow(axes, (0.028, 0.0), colour, other, (-10, -18))
    axes.plot(0, 0, "o", color="black", markersize=6, zorder=6)
    axes.annotate("c", (0.0, 0.0), xytext=(6, -14), textcoords="offset points", fontweight="bold")
    axes.plot(0, gripper.depth, "o", color="black", markersize=4, zorder=6)
    axes.annotate("c + D X", (0.0, gripper.depth), xytext=(8, 4), textcoords="offset points")
    axes.set_aspect("equal")
    # Y (or Z) to the left keeps the frame right-handed on paper.
    axes.set_xlim(*((0.082, -0.082) if across == 1 else (0.06, -0.06)))
    axes.set_ylim(-0.068, 0.08)
    axes.axis("off")


def add_box(axes: Axes, box: Box, across: int, colour: str, style: str) -> None:
    """One box as a rectangle."""
    corner = (box.lower[across], box.lower[0])
    size = (box.upper[across] - box.lower[across], box.upper[0] - box.lower[0])
    axes.add_patch(Rectangle(corner, *size, facecolor=colour, edgecolor="#4a5568", linestyle=style, alpha=0.85))


def arrow(axes: Axes, tip: tuple[float, float], colour: str, text: str, offset: tuple[int, int]) -> None:
    """An axis of the frame from the origin."""
    axes.annotate("", tip, (0, 0), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.4}, zorder=5)
    axes.annotate(text, tip, xytext=offset, textcoords="offset points", color=colour, fontweight="bold", zorder=7)


def dimension(
    axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str, *, rotate: bool = True
) -> None:
    """A dimension line between two points, with its name."""
    axes.annotate("", start, end, arrowprops={"arrowstyle": "<->", "color": "#4a5568", "lw": 1.1})
    middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
    offset = (10, 0) if rotate else (0, 7)
    axes.annotate(
        text, middle, xytext=offset, textcoords="offset points", ha="left" if rotate else "center", va="center"
    )


if __name__ == "__main__":
    main()
