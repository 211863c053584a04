"""Checks the labels of a data set: collisions against exact meshes, and success in physics against the score s_q.

    python tools/check_labels.py DIR [--collisions 1000] [--trials 400] [--out docs/label_physics.png]

Collisions: labels drawn at random, judged by python-fcl on the true meshes. Physics: for each tenth of s_q the same
number of labels, drawn at random over scenes and widths, executed in the true scene by `GraspSimulator`.
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
        result.append(Trial(label.score, attempt.success, attempt.outcome.name, kind, width))
    return result


def report_collisions(judged: list[tuple[bool, float]]) -> None:
    collides, error = np.array([hit for hit, _ in judged]), np.array([difference for _, difference in judged])
    print(f"collision-free by python-fcl: {100 * (1 - collides.mean()):.2f} % of {len(judged)} labels")
    print(
        f"s_q against rays: median difference {np.median(error):.4f}, below 0.1 for {100 * (error < 0.1).mean():.1f} %"
    )


def report_physics(trials: list[Trial], out: Path | None) -> None:
    score, success = np.array([t.score for t in trials]), np.array([t.success for t in trials], float)
    tenth = np.clip(np.digitize(score, BINS) - 1, 0, 9)
    rate = np.array([success[tenth == t].mean() if (tenth == t).any() else np.nan for t in range(10)])
    middle = np.array([score[tenth == t].mean() if (tenth == t).any() else np.nan for t in range(10)])
    for t in range(10):
        print(f"s_q {BINS[t]:.1f} to {BINS[t + 1]:.1f}: {100 * rate[t]:5.1f} % of {(tenth == t).sum()} held")
    there = np.isfinite(rate)
    pearson = float(np.corrcoef(middle[there], rate[there])[0, 1])
    high, low = success[score > 0.9], success[score < 0.3]
    print(f"s_q > 0.9: {100 * high.mean():.1f} % of {len(high)}; s_q < 0.3: {100 * low.mean():.1f} % of {len(low)}")
    print(f"Pearson of the tenths: {pearson:.4f} (the paper's: 0.9687)")
    print("outcomes of s_q > 0.9:", json.dumps(Counter(t.outcome for t in trials if t.score > 0.9)))
    print("outcomes of all:", json.dumps(Counter(t.outcome for t in trials)))
    for kind in sorted({t.kind for t in trials}):
        own = [t.success for t in trials if t.kind == kind and t.score > 0.9]
        print(f"  {kind}, s_q > 0.9: {100 * np.mean(own):.0f} % of {len(own)}" if own else f"  {kind}: none")
    if out is not None:
        draw(score, success, middle, rate, pearson, out)


def draw(
    score: NDArray[np.float64],
    success: NDArray[np.float64],
    middle: NDArray[np.float64],
    rate: NDArray[np.float64],
    pearson: float,
    out: Path,
) -> None:
    """The share of labels held against s_q, with 95 % intervals (Wilson)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tenth = np.clip(np.digitize(score, BINS) - 1, 0, 9)
    count = np.bincount(tenth, minlength=10)
    z, p, n = 1.96, np.nan_to_num(rate), np.maximum(count, 1)
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    figure, axes = plt.subplots(figsize=(6.4, 4.2), dpi=130)
    error = np.clip(np.stack([p - (centre - half), centre + half - p]), 0.0, None)
    axes.errorbar(middle, p, yerr=error, marker="o", capsize=3, color="#1b6e9c", label="held, with 95 % interval")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="antipodal score $s_q$ of the label", ylabel="share held in physics")
    axes.set_title(f"{len(success)} labels executed in MuJoCo: Pearson {pearson:.3f}", fontsize=11)
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
