"""The command line: `python -m benchmarks`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.clouds import cloud_source
from benchmarks.comparison import compare, comparison_table, worse_by
from benchmarks.documents import read_document, write_document
from benchmarks.errors import BenchmarkError
from benchmarks.goals import goal_table
from benchmarks.growth import ALLOWED, measure_memory
from benchmarks.machine import ROOT, describe_machine
from benchmarks.measure import QUIET, MatrixSettings, load_warning, measure_matrix
from benchmarks.models import PRECISIONS
from benchmarks.picture import draw
from benchmarks.records import Document
from benchmarks.tables import BEGIN, END, STAGES_BEGIN, STAGES_END, replaced, result_tables, stage_table
from regnet_core.errors import RegnetError
from regnet_core.models import is_weights_path

PARTS = ("stages", "reference", "ros", "memory")
README = Path(__file__).resolve().parent / "README.md"


def make_parser() -> argparse.ArgumentParser:
    """All subcommands and their options."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Benchmarks; see benchmarks/README.md.")
    commands = parser.add_subparsers(dest="command", required=True)
    _add_run(commands.add_parser("run", help="measure, and write a JSON file"))
    for name, text in (("table", "a file as tables in Markdown"), ("picture", "a file as a picture")):
        command = commands.add_parser(name, help=text)
        command.add_argument("file", type=Path)
        if name == "picture":
            command.add_argument("--out", type=Path, help="default: the file's name with .png")
        else:
            command.add_argument("--readme", action="store_true", help="put them into benchmarks/README.md")
    command = commands.add_parser("compare", help="two files side by side, as ratios")
    command.add_argument("before", type=Path)
    command.add_argument("after", type=Path)
    command.add_argument("--fail-above", type=float, help="exit with 1 where something is this much worse")
    command = commands.add_parser("stages", help="what the stages are")
    command.add_argument("--readme", action="store_true", help="put the list into benchmarks/README.md")
    return parser


def _add_run(run: argparse.ArgumentParser) -> None:
    add = run.add_argument
    add("--out", type=Path, required=True, metavar="FILE.json")
    add("--picture", type=Path, help="also draw one")
    add("--parts", nargs="+", choices=PARTS, default=["stages", "reference", "ros"], help="default: all but memory")
    add("--models", nargs="+", default=["regnetv2-s", "regnetv2", "antipodal"],
        help="names, .safetensors files, or untrained:NAME; a network without weights gets random ones")  # fmt: skip
    add("--precisions", nargs="+", choices=PRECISIONS, default=list(PRECISIONS))
    add("--threads", nargs="+", type=int, default=[1, 2])
    add("--clouds", nargs="+", default=["bags/clutter_20", "bags/tilted_depth_only"],
        help="BAG, BAG:NUMBER, a cloud file, or made-up:POINTS")  # fmt: skip
    add("--points", type=int, default=0, help="most points after preprocessing; 0: as config/regnet.yaml says")
    add("--crop", nargs=6, type=float, default=[], metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="workspace of the preprocessor, for stages and reference [m]; default: no crop")  # fmt: skip
    add("--width", type=float, default=0.08, help="gripper width [m]")
    add("--repetitions", type=int, default=20)
    add("--warm-up", type=int, default=3, help="repetitions that do not count")
    add("--weights-seed", type=int, default=0, help="of random weights")
    add("--reference", nargs="+", default=["regnetv2"], metavar="NETWORK", help="whose plain implementation to measure")
    add("--reference-repetitions", type=int, default=3)
    add("--ros-models", nargs="+", default=["regnetv2-s"])
    add("--ros-cloud", default="bags/tilted_depth_only", help="for publication to arrival (default: %(default)s)")
    add("--ros-clouds", type=int, default=50, help="how often it is published")
    add("--ros-bag", type=Path, default=Path("bags/tilted_depth_only"), help="to be replayed (default: %(default)s)")
    add("--ros-seconds", type=float, default=20.0, help="for how long")
    add("--at-a-time", nargs="+", type=int, default=[1, 2], help="clouds that the detector node works on at a time")
    add("--offered", type=float, default=20.0, help="clouds a second of the replayed bag")
    add("--detections", type=int, default=10_000, help="for the memory")
    add("--node-detections", type=int, default=0, help="for the memory of the nodes, from the replayed bag; 0: none")
    add("--allowed-growth", type=float, default=ALLOWED, help="in 10,000 detections [bytes] (default: %(default).0f)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a subcommand; the exit code: 0, 1 where something is worse or grows, 2 for what cannot be done."""
    options = make_parser().parse_args(arguments)
    try:
        return {"run": _run, "table": _table, "picture": _picture, "compare": _compare, "stages": _stages}[
            options.command
        ](options)
    except RegnetError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace) -> int:
    document = measure(options)
    write_document(options.out, document)
    print(f"wrote {options.out}")
    if options.picture:
        draw(document, options.picture)
        print(f"wrote {options.picture}")
    print(f"\n{_everything(document)}")
    return 1 if any(record.grows for record in document.memory) else 0


def measure(options: argparse.Namespace) -> Document:
    """Everything that the options of `run` ask for.

    Raises:
        BenchmarkError: a measurement cannot be made.
        InvalidInputError: an option makes no sense.
    """
    options.clouds = [cloud_source(text).text for text in options.clouds]
    options.ros_cloud = cloud_source(options.ros_cloud).text
    for name in ("models", "ros_models", "reference"):
        setattr(options, name, [_anywhere(model) for model in getattr(options, name)])
    document = Document(
        created=datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        machine=describe_machine(),
        settings=_settings(options),
    )
    if "ros" in options.parts or ("memory" in options.parts and options.node_detections):
        from benchmarks.ros.system import check_ros

        check_ros()
    document = _measure_matrix(options, document)
    if "ros" in options.parts:
        document = _measure_ros(options, document)
    if "memory" in options.parts:
        document = _measure_memory(options, document)
    return document


def _settings(options: argparse.Namespace) -> dict[str, str]:
    """What numbers depend on, besides what every record says of itself."""
    names = ("points", "crop", "width", "weights_seed", "offered")
    return {name: str(getattr(options, name)) for name in names}


def _measure_matrix(options: argparse.Namespace, document: Document) -> Document:
    stages, reference = "stages" in options.parts, "reference" in options.parts
    if not stages and not reference:
        return document
    result = measure_matrix(
        MatrixSettings(
            models=tuple(options.models) if stages else (),
            precisions=tuple(options.precisions),
            threads=tuple(options.threads),
            clouds=tuple(options.clouds),
            points=options.points,
            crop=tuple(options.crop),
            width=options.width,
            repetitions=options.repetitions,
            warm_up=options.warm_up,
            references=tuple(options.reference) if reference else (),
            reference_repetitions=options.reference_repetitions,
            weights_seed=options.weights_seed,
        ),
        _say,
    )
    warning = load_warning(result.load)
    return replace(
        document,
        load=result.load,
        peaks=result.peaks,
        runs=result.runs,
        references=result.references,
        warnings=(*document.warnings, *([warning] if warning else [])),
    )


def _measure_ros(options: argparse.Namespace, document: Document) -> Document:
    from benchmarks.ros.latency import LatencySettings, measure_latency
    from benchmarks.ros.throughput import ThroughputSettings, measure_throughput

    latencies, throughputs = [], []
    for model in options.ros_models:
        for threads in options.threads:
            common = {"threads": threads, "width": options.width, "weights_seed": options.weights_seed}
            latencies.append(
                measure_latency(LatencySettings(model, options.ros_cloud, clouds=options.ros_clouds, **common), _say)
            )
            for at_a_time in options.at_a_time:
                settings = ThroughputSettings(
                    model,
                    options.ros_bag.resolve(),
                    options.offered,
                    options.ros_seconds,
                    at_a_time=at_a_time,
                    **common,
                )
                throughputs.append(measure_throughput(settings, _say))
    others = max([*(item.others for item in latencies), *(item.others for item in throughputs)])
    warnings = document.warnings
    if others >= QUIET:
        warnings = (*warnings, f"other processes kept {others:.2f} cores busy during the end-to-end measurements")
    return replace(document, latencies=tuple(latencies), throughputs=tuple(throughputs), warnings=warnings)


def _measure_memory(options: argparse.Namespace, document: Document) -> Document:
    records = [
        measure_memory(
            model,
            options.clouds,
            options.detections,
            threads=max(options.threads),
            points=options.points,
            weights_seed=options.weights_seed,
            allowed=options.allowed_growth,
            say=_say,
        )
        for model in options.models
    ]
    if options.node_detections:
        from benchmarks.ros.throughput import ThroughputSettings, measure_node_memory

        for model in options.ros_models:
            settings = ThroughputSettings(
                model, options.ros_bag.resolve(), options.offered, threads=max(options.threads), width=options.width
            )
            records += measure_node_memory(settings, options.node_detections, options.allowed_growth, _say)
    return replace(document, memory=tuple(records))


def _everything(document: Document) -> str:
    return f"{goal_table(document)}\n\n{result_tables(document)}".strip() + "\n"


def _table(options: argparse.Namespace) -> int:
    text = _everything(read_document(options.file))
    if options.readme:
        _into_readme(BEGIN, END, text)
    else:
        print(text)
    return 0


def _picture(options: argparse.Namespace) -> int:
    out = options.out or options.file.with_suffix(".png")
    draw(read_document(options.file), out)
    print(f"wrote {out}")
    return 0


def _compare(options: argparse.Namespace) -> int:
    before, after = read_document(options.before), read_document(options.after)
    changes = compare(before, after)
    print(comparison_table(before, after, changes))
    worse = [] if options.fail_above is None else worse_by(changes, options.fail_above)
    for change in worse:
        print(f"worse by more than {options.fail_above:g}: {change.what}, {change.ratio:.2f} times")
    return 1 if worse else 0


def _stages(options: argparse.Namespace) -> int:
    if options.readme:
        _into_readme(STAGES_BEGIN, STAGES_END, stage_table())
    else:
        print(stage_table())
    return 0


def _into_readme(begin: str, end: str, content: str) -> None:
    try:
        README.write_text(replaced(README.read_text(encoding="utf-8"), begin, end, content), encoding="utf-8")
    except ValueError as error:
        raise BenchmarkError(f"{README.relative_to(ROOT)}: {error}") from error
    print(f"wrote {README.relative_to(ROOT)}")


def _anywhere(model: str) -> str:
    """A model as workers understand it, whose working directory may be another."""
    return str(Path(model).resolve()) if is_weights_path(model) else model


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
