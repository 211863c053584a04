"""The picture of a calibration: what was counted, the fitted curves, and the paper's beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

from regnet_core.geometry import Array
from regnet_core.policies import load_policy
from regnet_core.robots.calibration import Calibration
from regnet_core.robots.fits import GraspFit, ReachFit
from regnet_core.robots.model import get_robot

_BINS = 20
_FEWEST = 3
"""A bin with fewer samples is not drawn."""
_OWN, _PAPER = "#1b6e9c", "#c0392b"


class Frequencies(NamedTuple):
    """Shares of successes in bins of a score."""

    score: Array
    """(B,) mean of the bin's samples."""
    share: Array
    """(B,)"""
    error: Array
    """(2, B) how far the interval of one standard deviation (Wilson's) reaches below and above."""


def binned(score: Array, success: Array, bins: int = _BINS) -> Frequencies:
    """Bins of one width over [0, 1]; those with few samples are left out."""
    place = np.clip((score * bins).astype(int), 0, bins - 1)
    count = np.bincount(place, minlength=bins)
    kept = count >= _FEWEST
    n = count[kept].astype(float)
    share = np.bincount(place, success, bins)[kept] / n
    middle = (share + 0.5 / n) / (1.0 + 1.0 / n)
    reach = np.sqrt(share * (1.0 - share) / n + 0.25 / n**2) / (1.0 + 1.0 / n)
    error = np.maximum(0.0, np.stack([share - (middle - reach), middle + reach - share]))
    return Frequencies(np.bincount(place, score, bins)[kept] / n, share, error)


def draw_calibration(calibration: Calibration, path: Path) -> None:
    """Write the picture (.png)."""
    style: Any = {"font.family": "DejaVu Sans", "font.size": 10, "axes.titlesize": 11}
    with plt.rc_context(style):
        figure, axes = plt.subplots(1, 2, figsize=(10.4, 4.2), dpi=120)
        _draw_reach(axes[0], calibration)
        _draw_grasp(axes[1], calibration)
        figure.suptitle(get_robot(calibration.robot).title)
        figure.tight_layout()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)


def _draw_reach(axis: Axes, calibration: Calibration) -> None:
    samples, fit = calibration.reach_samples, calibration.reach
    paper = load_policy("paper").policy
    x = np.linspace(0.0, 1.0, 201)
    _draw_frequencies(axis, binned(samples.vertical_score, samples.reached.astype(float)), len(samples.reached))
    axis.plot(x, fit.probability(x), color=_OWN, label=f"fit: k {fit.slope:.2f}, $s_0$ {fit.midpoint:.3f}")
    known = ReachFit(paper.slope, paper.midpoint, 0.0, 0.0)
    label = f"paper: k {paper.slope:.2f}, $s_0$ {paper.midpoint:.3f}"
    axis.plot(x, known.probability(x), color=_PAPER, linestyle="--", label=label)
    _finish(axis, "P(reach)", "vertical score $s_v$")


def _draw_grasp(axis: Axes, calibration: Calibration) -> None:
    quality, fit = calibration.trials.quality(calibration.quality), calibration.grasp
    paper = load_policy("paper").policy
    x = np.linspace(0.0, 1.0, 201)
    _draw_frequencies(axis, binned(quality, calibration.trials.held, 10), len(quality))
    axis.plot(x, fit.probability(x), color=_OWN, label=f"fit: {fit.gain:.3f} $s_q$ {fit.offset:+.3f}")
    known = GraspFit(paper.quality_gain, paper.quality_offset, 0.0, 0.0)
    label = f"paper: {paper.quality_gain:.3f} $s_q$ {paper.quality_offset:+.3f}"
    axis.plot(x, known.probability(x), color=_PAPER, linestyle="--", label=label)
    _finish(axis, "P(grasp | reach)", f"{calibration.quality} quality $s_q$")


def _draw_frequencies(axis: Axes, frequencies: Frequencies, count: int) -> None:
    axis.errorbar(
        frequencies.score, frequencies.share, yerr=frequencies.error, fmt="o", markersize=4.5, capsize=2.5,
        color="#2f3b47", label=f"counted, n = {count}",
    )  # fmt: skip


def _finish(axis: Axes, title: str, label: str) -> None:
    axis.set_title(title)
    axis.set_xlabel(label)
    axis.set_xlim(0.0, 1.0)
    axis.set_ylim(-0.02, 1.05)
    axis.grid(color="#e6e9ee", linewidth=0.8)
    axis.set_axisbelow(True)
    axis.legend(loc="upper left", frameon=False)
