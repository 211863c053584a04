"""Compares methods on the cameras that data sets have with the same methods on one that no data set has.

    python tools/study_unseen_camera.py data/test --model antipodal --model regnetv2-s [--out FOLDER]

Each scene is seen once by one of its own cameras and once by the unseen one (regnet_core/evaluation/unseen_camera.py),
and judged as `regnet evaluate` does. The change is that of each scene, its error the standard error over scenes.
--out writes seen.json and unseen.json, as `regnet evaluate --out` does.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, TaskID
from rich.table import Table

from regnet_core.cli.evaluation_tables import METRICS
from regnet_core.cli.tables import make_console
from regnet_core.data.generation.executors import LocalExecutor
from regnet_core.data.storage.archive import SceneArchive
from regnet_core.evaluation.document import study_document, write_document
from regnet_core.evaluation.observed import POINTS, CloudSource, RecordedViews
from regnet_core.evaluation.study import StudySettings, ViewResult, run_study
from regnet_core.evaluation.summary import Estimate, estimate
from regnet_core.evaluation.unseen_camera import NOISE, UnseenViews, beyond_training


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a data set made by `regnet generate`")
    parser.add_argument("--model", action="append", required=True, help="name, or .safetensors; several times")
    parser.add_argument("--scenes", type=int, help="the first so many (default: all)")
    parser.add_argument("--width", type=float, action="append", help="gripper width [m] (default: all of the data set)")
    parser.add_argument("--noise", type=float, default=NOISE, help=f"factor on the unseen one's noise ({NOISE:g})")
    parser.add_argument("--points", type=int, default=POINTS, help=f"most points of a cloud ({POINTS})")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--workers", type=int, default=0, help="processes (default: one for each core)")
    parser.add_argument("--out", type=Path, help="folder for the results")
    arguments = parser.parse_args()
    archive, executor = SceneArchive(arguments.data), LocalExecutor(arguments.workers)
    settings = StudySettings(
        models=tuple(arguments.model),
        widths=tuple(arguments.width or archive.widths),
        scenes=archive.indices[: arguments.scenes],
        seed=arguments.seed,
        device=arguments.device,
    )
    sources: dict[str, CloudSource] = {
        "seen": RecordedViews(arguments.points, arguments.seed),
        "unseen": UnseenViews(arguments.points, arguments.seed, arguments.noise),
    }
    results: dict[str, list[ViewResult]] = {}
    with Progress(console=Console(stderr=True)) as progress:
        for name, clouds in sources.items():
            own, task = replace(settings, clouds=clouds), progress.add_task(f"{name} cameras")
            results[name] = run_study(archive, own, executor, shown_by(progress, task))
            if arguments.out is not None:
                document = study_document(archive, own, results[name], executor.workers)
                write_document(arguments.out / f"{name}.json", document)
    console = make_console()
    console.print(camera_table(arguments.noise))
    console.print(comparison_table(results["seen"], results["unseen"]))


def shown_by(progress: Progress, task: TaskID) -> Callable[[int, int], None]:
    """What a study calls to move a bar."""
    return lambda done, total: progress.update(task, completed=done, total=total)


def camera_table(noise: float) -> Table:
    """What the unseen camera has that the others have not."""
    table = Table("camera", "data sets", "unseen", box=SIMPLE_HEAD, pad_edge=False)
    for row in beyond_training(noise):
        table.add_row(*(escape(text) for text in row))
    return table


def comparison_table(seen: Sequence[ViewResult], unseen: Sequence[ViewResult]) -> Table:
    """Each metric of each method with both kinds of camera; both lists have the same scenes, widths and methods."""
    table = Table("method", "metric", box=SIMPLE_HEAD, pad_edge=False)
    for name in ("seen", "unseen", "change", "error"):
        table.add_column(name, justify="right")
    for model in dict.fromkeys(result.model for result in seen):
        before, after = ([r for r in results if r.model == model] for results in (seen, unseen))
        for title, metric in METRICS.items():
            shown = [f"{mean(results, metric):.4f}" for results in (before, after)]
            by = change(before, after, metric)
            table.add_row(model if title == "CFR" else "", title, *shown, f"{by.mean:+.4f}", f"{by.error:.4f}")
    return table


def mean(results: Sequence[ViewResult], metric: str) -> float:
    """Over all results that can be judged."""
    return estimate([getattr(r.metrics, metric) for r in results], [r.scene for r in results]).mean


def change(seen: Sequence[ViewResult], unseen: Sequence[ViewResult], metric: str) -> Estimate:
    """From the seen to the unseen camera, over the scenes and widths that both can be judged for."""
    before = {(r.scene, r.metrics.width): getattr(r.metrics, metric) for r in seen}
    differences = [getattr(r.metrics, metric) - before[r.scene, r.metrics.width] for r in unseen]
    return estimate(differences, [r.scene for r in unseen])


if __name__ == "__main__":
    main()
