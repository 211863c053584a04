"""Checks the labels of a data set: collisions against exact meshes, and success in physics against the score s_q.

    python tools/check_labels.py DIR [--collisions 1000] [--trials 400] [--out docs/label_physics.png]

Collisions: labels drawn at random, judged by python-fcl on the true meshes. Physics: for each tenth of s_q the same
number of labels, drawn at random over scenes and widths, executed in the true scene by `GraspSimulator`. A label is
held as planned if the object is held and did not turn in the hand by more than 20 degrees: s_q is that of the contacts
as labelled, and a thin object that is gripped askew turns until it lies flush with the pads.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.evaluation.ground_truth import GroundTruth
from regnet_core.gripper import Gripper
from regnet_core.sim.simulator import GraspSimulator

BINS = np.linspace(0.0, 1.0, 11)
AS_PLANNED = np.radians(20.0)
"""An object that turns more than this in the hand is not held as planned [rad]."""


class Label(NamedTuple):
    """Which label of a data set."""

    scene: int
    width_index: int
    row: int
    score: float


class Trial(NamedTuple):
    """A label that was executed."""

    score: float
    success: bool
    planned: bool
    """Held, and not turned in the hand."""
    outcome: str
    kind: str
    width: float


Labels = tuple[Label, ...]
"""Labels of one scene."""
Result = TypeVar("Result")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a data set made by `regnet generate`")
    parser.add_argument("--collisions", type=int, default=1000, help="labels to judge (default: 1000)")
    parser.add_argument("--trials", type=int, default=400, help="labels to execute (default: 400)")
    parser.add_argument("--seed", type=int, default=0, help="of the labels that are drawn")
    parser.add_argument("--out", type=Path, help="picture of success against s_q (.png)")
    arguments = parser.parse_args()
    archive = SceneArchive(arguments.folder)
    every = all_labels(archive)
    rng = np.random.default_rng(arguments.seed)
    print(f"{len(every)} labels in {len(archive)} scenes")
    chosen = [every[i] for i in rng.choice(len(every), min(arguments.collisions, len(every)), replace=False)]
    report_collisions([pair for part in run(judge, arguments.folder, chosen) for pair in part])
    chosen = evenly_over_scores(every, arguments.trials, rng)
    report_physics([trial for part in run(execute, arguments.folder, chosen) for trial in part], arguments.out)


def all_labels(archive: SceneArchive) -> list[Label]:
    """Every label of the data set."""
    return [
        Label(scene, w, row, float(score))
        for scene in archive
        for w, labels in enumerate(archive.labels(scene))
        for row, score in enumerate(labels.score)
    ]


def evenly_over_scores(labels: list[Label], count: int, rng: np.random.Generator) -> list[Label]:
    """The same number of labels from each tenth of the score."""
    tenth = np.clip(np.digitize([label.score for label in labels], BINS) - 1, 0, 9)
    rows = [rng.permutation(np.flatnonzero(tenth == t))[: count // 10] for t in range(10)]
    return [labels[i] for i in np.concatenate(rows)]


def run(function: Callable[[Path, Labels], Result], folder: Path, labels: list[Label]) -> Iterator[Result]:
    """Calls the function for the labels of each scene, on all cores."""
    scenes = sorted({label.scene for label in labels})
    items = [tuple(label for label in labels if label.scene == scene) for scene in scenes]
    return (result for _, result in LocalExecutor().run(function, folder, items))


def judge(folder: Path, chosen: Labels) -> list[tuple[bool, float]]:
    """For each label whether the hand collides, and how far its score is from that of rays on the true meshes."""
    archive, index = SceneArchive(folder), chosen[0].scene
    scene, labels = archive.scene(index), archive.labels(index)
    truth = GroundTruth(scene.world_meshes(), scene.table, fixtures=scene.fixtures)
    result = []
    for label in chosen:
        width = archive.widths[label.width_index]
        grasp, gripper = labels[label.width_index].grasps(width)[label.row], Gripper(width=width)
        error = abs(float(truth.antipodal(grasp, gripper).score[0]) - label.score)
        result.append((bool(truth.collides(grasp, gripper)[0]), error))
    return result


def execute(folder: Path, chosen: Labels) -> list[Trial]:
    """Tries each label in physics."""
    archive, index = SceneArchive(folder), chosen[0].scene
    scene, labels, kind = archive.scene(index), archive.labels(index), archive.info(index).kind
    result = []
    for label in chosen:
        width, own = archive.widths[label.width_index], labels[label.width_index]
        simulator = GraspSimulator(scene, Gripper(width=width))
        attempt = simulator.attempt(own.grasps(width)[label.row], target=int(own.object_index[label.row]))
        planned = attempt.success and attempt.turn <= AS_PLANNED
        result.append(Trial(label.score, attempt.success, planned, attempt.outcome.name, kind, width))
    return result


def report_collisions(judged: list[tuple[bool, float]]) -> None:
    collides, error = np.array([hit for hit, _ in judged]), np.array([difference for _, difference in judged])
    print(f"collision-free by python-fcl: {100 * (1 - collides.mean()):.2f} % of {len(judged)} labels")
    print(
        f"s_q against rays: median difference {np.median(error):.4f}, below 0.1 for {100 * (error < 0.1).mean():.1f} %"
    )


def report_physics(trials: list[Trial], out: Path | None) -> None:
    score = np.array([trial.score for trial in trials])
    held = Curve.of(score, np.array([trial.success for trial in trials]))
    planned = Curve.of(score, np.array([trial.planned for trial in trials]))
    for t in range(len(held.trials)):
        print(
            f"s_q {BINS[t]:.1f} to {BINS[t + 1]:.1f}: {100 * held.rate[t]:5.1f} % held, "
            f"{100 * planned.rate[t]:5.1f} % as planned, of {held.trials[t]}"
        )
    print(f"Pearson with s_q: held {held.pearson:.4f}, as planned {planned.pearson:.4f} (the paper's: 0.9687)")
    for name, chosen in (("s_q > 0.9", score > 0.9), ("s_q < 0.3", score < 0.3)):
        own = [trial for trial, yes in zip(trials, chosen, strict=True) if yes]
        shares = [100 * np.mean([getattr(trial, what) for trial in own]) for what in ("success", "planned")]
        outcomes = json.dumps(Counter(trial.outcome for trial in own))
        print(f"{name}: {shares[0]:.1f} % held, {shares[1]:.1f} % as planned, of {len(own)}: {outcomes}")
    for kind in sorted({trial.kind for trial in trials}):
        own = [trial for trial in trials if trial.kind == kind and trial.score > 0.9]
        if own:
            print(f"  {kind}, s_q > 0.9: {100 * np.mean([trial.success for trial in own]):.0f} % held of {len(own)}")
    if out is not None:
        draw(held, planned, len(trials), out)


class Curve(NamedTuple):
    """Share of successes against the score, by tenths."""

    score: NDArray[np.float64]
    """(10,) mean score."""
    rate: NDArray[np.float64]
    """(10,) share; NaN without trials."""
    trials: NDArray[np.int64]
    """(10,)."""

    @classmethod
    def of(cls, score: NDArray[np.float64], success: NDArray[np.bool_]) -> "Curve":
        tenth = np.clip(np.digitize(score, BINS) - 1, 0, 9)
        count = np.bincount(tenth, minlength=10)
        with np.errstate(invalid="ignore"):
            means = [np.bincount(tenth, weights=values, minlength=10) / count for values in (score, success)]
        return cls(means[0], means[1], count)

    @property
    def pearson(self) -> float:
        """Correlation of share and score."""
        there = self.trials > 0
        return float(np.corrcoef(self.score[there], self.rate[there])[0, 1])

    def interval(self) -> NDArray[np.float64]:
        """(2, 10) how far the ends of Wilson's 95 % interval are below and above the share."""
        z, p, n = 1.96, np.nan_to_num(self.rate), np.maximum(self.trials, 1)
        centre = (p + z * z / (2 * n)) / (1 + z * z / n)
        half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
        return np.clip(np.stack([p - centre + half, centre + half - p]), 0.0, None)


def draw(held: Curve, planned: Curve, trials: int, out: Path) -> None:
    """Both curves with their 95 % intervals."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.2), dpi=130)
    for curve, colour, name in (
        (held, "#9aa7b5", f"held (Pearson {held.pearson:.2f})"),
        (planned, "#1b6e9c", f"held as planned (Pearson {planned.pearson:.2f})"),
    ):
        axes.errorbar(curve.score, curve.rate, yerr=curve.interval(), marker="o", capsize=3, color=colour, label=name)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="antipodal score $s_q$ of the label", ylabel="share of the labels")
    axes.set_title(f"{trials} labels executed in MuJoCo", fontsize=11)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
