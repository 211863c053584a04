"""Results of benchmarks: statistics, shares of the peak, documents, comparison, tables, goals."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from benchmarks.analysis import with_share
from benchmarks.cli import README, main
from benchmarks.comparison import compare, comparison_table, worse_by
from benchmarks.documents import read_document, write_document
from benchmarks.goals import GOALS, goal_table
from benchmarks.growth import MemorySample, memory_record
from benchmarks.machine import Machine, cpu_seconds, peak_bytes, resident_bytes
from benchmarks.measure import load_of, load_warning
from benchmarks.records import (
    Document,
    LatencyRecord,
    MemoryRecord,
    NodeUse,
    PeakRecord,
    ReferenceRecord,
    RunRecord,
    StageRecord,
    ThroughputRecord,
)
from benchmarks.summary import Summary, fit_line
from benchmarks.tables import STAGES_BEGIN, STAGES_END, replaced, result_tables, speed_ups, stage_table
from benchmarks.work import Work
from regnet_core.errors import InvalidInputError


def spread(median: float, share: float = 0.1) -> Summary:
    """Five measurements around a median."""
    return Summary.of([median * (1.0 + share * step) for step in (-1.0, -0.5, 0.0, 0.5, 1.0)])


def machine(processor: str = "Made Up 1") -> Machine:
    return Machine(processor, ("avx2",), 2, 1 << 20, 1 << 33, "3.12.0", {"numpy": "2.0"}, "", "abc")


PEAK = PeakRecord(
    2, fp32=spread(100e9), bf16=spread(1000e9), copy=spread(20e9), triad=spread(25e9), int8=spread(2000e9)
)


def run_of(total: float = 0.2, cloud: str = "bag 0", model: str = "regnetv2") -> RunRecord:
    stage = StageRecord(
        "abstraction 1", "detector", "network", 1.0, spread(total / 2), spread(total / 2), 3e9, 2e9, 1e6
    )
    return RunRecord(
        model, "random, seed 0", "bf16", 2, cloud, 50_000, 40_000, 25_600, 12, spread(total), spread(2 * total),
        spread(total), spread(total * 0.8), spread(0.01), spread(0.02), 10**9, (stage,),
    )  # fmt: skip


def document(total: float = 0.2) -> Document:
    """One of everything."""
    plain = ReferenceRecord("regnetv2", 2, "bag 0", 25_600, *(spread(v) for v in (2.0, 0.5, 1.5, 2.5)), 1e-5)
    latency = LatencyRecord(
        "regnetv2-s", "trained", 2, "bag 0", 217_088, 10**6, 50, 20, spread(total), total * 1.2, spread(total * 0.7),
        spread(total * 0.3), spread(total * 0.9), {"preprocessor total": spread(0.01)}, spread(0.005), 0.0,
    )  # fmt: skip
    flow = ThroughputRecord(
        "regnetv2-s",
        "trained",
        2,
        "bag",
        20.0,
        19.5,
        16.5,
        20.0,
        (NodeUse("detector", 1.5, 10**8, 2 * 10**8),),
        0.0,
        2,
        0.1,
    )
    memory = MemoryRecord("regnetv2-s", "trained", "library", 10_000, 10**8, 2 * 10**8, 1e5, 1e4, 2e7, 900.0)
    return Document(
        "2030-01-01T00:00:00Z", machine(), {"width": "0.08"}, load_of([0.0, 0.05]), (PEAK,), (run_of(total),),
        (plain,), (latency,), (flow,), (memory,), ("a warning",),
    )  # fmt: skip


def test_a_summary_has_interpolated_quartiles() -> None:
    assert Summary.of([4.0, 1.0, 3.0, 2.0]) == Summary(4, 2.5, 1.75, 3.25, 1.0, 4.0)
    assert Summary.of([7.0]) == Summary(1, 7.0, 7.0, 7.0, 7.0, 7.0)
    assert Summary.of([1.0, 3.0]).scaled(1e3) == Summary(2, 2000.0, 1500.0, 2500.0, 1000.0, 3000.0)


@pytest.mark.parametrize("values", [[], [1.0, float("nan")], [float("inf")]])
def test_a_summary_refuses_what_it_cannot_summarise(values: list[float]) -> None:
    with pytest.raises(InvalidInputError, match="at least one finite number"):
        Summary.of(values)


def test_a_line_through_points_and_its_error() -> None:
    exact = fit_line([0.0, 1.0, 2.0, 5.0], [3.0, 5.0, 7.0, 13.0])
    assert (exact.slope, exact.intercept) == pytest.approx((2.0, 3.0))
    assert exact.error == pytest.approx(0.0, abs=1e-12)
    # y = 0, 1, 0 has no slope; residuals -1/3, 2/3, -1/3; variance (2/3) / 1 over a spread of 2.
    bent = fit_line([0.0, 1.0, 2.0], [0.0, 1.0, 0.0])
    assert bent.slope == pytest.approx(0.0)
    assert bent.error == pytest.approx((2 / 3 / 2) ** 0.5)
    with pytest.raises(InvalidInputError, match="three points at different places"):
        fit_line([1.0, 1.0, 1.0], [0.0, 1.0, 2.0])


def test_growth_is_that_of_the_line_after_the_first_tenth() -> None:
    def samples(per_detection: float, count: int) -> list[MemorySample]:
        warm = [MemorySample(done, 10**8 + 10**5 * done, 2 * 10**8) for done in range(10, count // 10, 10)]
        later = [
            MemorySample(done, round(5 * 10**8 + per_detection * done), 7 * 10**8)
            for done in range(count // 10 + 1, count + 1, count // 100)
        ]
        return [*warm, *later[:-1], MemorySample(count, round(5 * 10**8 + per_detection * count), 7 * 10**8)]

    leak = memory_record("m", "none", "library", samples(2048.0, 10_000), 16 << 20, 1.0)
    assert leak.growth == pytest.approx(2048 * 10_000, rel=1e-3)
    assert leak.grows
    assert (leak.peak, leak.detections) == (7 * 10**8, 10_000)
    steady = memory_record("m", "none", "library", samples(100.0, 10_000), 16 << 20, 1.0)
    assert not steady.grows
    assert steady.steady == pytest.approx(5 * 10**8 + 100 * 7500, abs=1e5)
    short = memory_record("m", "none", "library", samples(2048.0, 2000), 16 << 20, 1.0)
    assert not short.conclusive and not short.grows


def test_a_busy_machine_is_warned_of() -> None:
    assert load_warning(load_of([0.0] * 19 + [1.0])) == ""
    assert "kept 1.50 cores busy" in load_warning(load_of([1.5, 1.5, 0.0]))


def test_memory_and_time_of_this_process() -> None:
    block = np.ones(32 << 20, np.uint8)
    assert resident_bytes() >= block.nbytes
    assert resident_bytes(os.getpid()) >= block.nbytes
    assert peak_bytes() >= block.nbytes
    assert abs(cpu_seconds(os.getpid()) - time.process_time()) < 0.5
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    assert resident_bytes(gone.pid) == peak_bytes(gone.pid) == cpu_seconds(gone.pid) == 0


def test_the_share_of_the_peak_is_of_what_takes_longest() -> None:
    stage = StageRecord("x", "detector", "network", 1.0, spread(0.2), spread(0.2))
    # fp32: 11 GFLOP at 110 GFLOP/s are 0.1 s; 1 GB at 27.5 GB/s is 0.036 s. The best of five is 1.1 times the median.
    computed = with_share(stage, Work(11e9, 1e9), 20e9, PEAK, "fp32")
    assert (computed.bound, computed.ledger_flops) == ("matrix product", 20e9)
    assert computed.share == pytest.approx(0.5)
    moved = with_share(stage, Work(11e9, 1e9), None, PEAK, "bf16")
    assert (moved.bound, moved.share) == ("memory", pytest.approx(1e9 / 27.5e9 / 0.2))
    assert with_share(stage, None, None, PEAK, "fp32").share is None
    assert with_share(stage, Work(11e9, 1e9), None, None, "fp32").share is None


def test_a_document_comes_back_from_its_file(tmp_path: Path) -> None:
    path, written = tmp_path / "new" / "one.json", document()
    write_document(path, written)
    read = read_document(path)
    assert read.runs[0].key == written.runs[0].key
    assert read.latencies[0].parts["preprocessor total"].median == pytest.approx(0.01)
    write_document(path, read)
    assert read_document(path) == read  # rounded once, it does not change any more
    assert dataclasses.replace(read, runs=()) != read
    assert str(tmp_path) not in path.read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.update(format="other/1"), r"its format is 'other/1', not 'regnet-benchmark/1'"),
        (lambda data: data["runs"][0].pop("total"), r"runs\[0\] has no 'total'"),
        (lambda data: data["runs"][0].update(threads="two"), r"runs\[0\].threads must be int, got 'two'"),
        (lambda data: data["peaks"][0]["fp32"].update(mean=1.0), r"peaks\[0\].fp32 has 'mean', which"),
        (lambda data: data.update(machine=[]), r"machine must be an object, got \[\]"),
    ],
)
def test_a_file_that_is_no_document_is_refused(tmp_path: Path, change: object, message: str) -> None:
    path = tmp_path / "one.json"
    write_document(path, document())
    data = json.loads(path.read_text())
    change(data)  # type: ignore[operator]
    path.write_text(json.dumps(data))
    with pytest.raises(InvalidInputError, match=message):
        read_document(path)


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="cannot be read"):
        read_document(tmp_path / "none.json")
    (tmp_path / "text.json").write_text("{")
    with pytest.raises(InvalidInputError, match="is no JSON"):
        read_document(tmp_path / "text.json")


def test_changes_beyond_the_spread_are_told_from_noise() -> None:
    before, slower, alike = document(0.2), document(0.3), document(0.205)
    changes = {change.what: change for change in compare(before, slower)}
    detection = changes["regnetv2, bf16, 2 threads, bag 0: detection"]
    assert (detection.ratio, detection.verdict) == (pytest.approx(1.5), "worse")
    assert changes["peak, 2 threads, fp32"].verdict == "same"
    assert {change.verdict for change in compare(before, alike)} == {"same"}
    back = {change.what: change.verdict for change in compare(slower, before)}
    assert back["regnetv2, bf16, 2 threads, bag 0: detector, abstraction 1"] == "better"
    assert [change.what for change in worse_by(list(changes.values()), 1.4)] == [
        "regnetv2, bf16, 2 threads, bag 0: detection",
        "regnetv2-s, 2 threads, bag 0: publication to arrival",
        "regnetv2-s, 2 threads, bag 0: all but the model",
    ]
    assert worse_by(list(changes.values()), 1.6) == []


def test_fewer_grasps_a_second_are_worse() -> None:
    before = document()
    after = dataclasses.replace(before, throughputs=(dataclasses.replace(before.throughputs[0], sustained=10.0),))
    change = next(change for change in compare(before, after) if "grasps a second" in change.what)
    assert (change.verdict, change.ratio) == ("worse", pytest.approx(10 / 16.5))
    assert worse_by([change], 1.5) == [change]


def test_what_speaks_against_a_comparison_is_said() -> None:
    before = document()
    after = dataclasses.replace(before, machine=machine("Other"), settings={"width": "0.06"}, runs=(), warnings=())
    text = comparison_table(before, after, compare(before, after))
    assert "Beware: the machines differ: processor Made Up 1 and Other." in text
    assert "Beware: the option width was 0.08 and is 0.06." in text
    assert "Beware: before: a warning." in text
    assert "Beware: 1 runs of the first file are not in the second." in text


def test_speed_ups_against_the_plain_implementation() -> None:
    one = document()
    network, layers_alone, whole = speed_ups(one.references[0], one.runs[0])
    assert network == pytest.approx(2.0 / 0.16)
    assert layers_alone == pytest.approx(1.5 / 0.16)
    assert whole == pytest.approx((0.04 + 2.0) / 0.2)


def test_tables_show_everything(tmp_path: Path) -> None:
    text = result_tables(document())
    for shown in (
        "Made Up 1", "**Warning:** a warning.", "| 2 | 110.0 | 1100.0 | 2200.0 | 22.0 | 27.5 |",
        "200.0 (190.0 to 210.0)",
        "regnetv2 (random, seed 0)", "| abstraction 1 | 100.00 |", "12.5 | 9.4 | 10.2 |", "detector 1.50",
        "+0.10 ± 0.01 | no |",
    ):  # fmt: skip
        assert shown in text
    for line in text.splitlines():
        assert not line.startswith("|") or line.endswith("|")


def test_goals_are_judged_on_the_side_where_they_lie() -> None:
    rows = [line.split(" | ") for line in goal_table(document(0.2)).splitlines()[2:]]
    assert len(rows) == len(GOALS) - 1  # there is no run of regnetv2-s
    assert [row[-1].strip(" |") for row in rows] == ["yes", "yes", "yes", "no", "yes"]
    slow = dataclasses.replace(document(0.2), runs=(run_of(0.2), run_of(0.3), run_of(0.1), run_of(0.3, "bag 1")))
    assert "| 300.0 | no |" in goal_table(slow).splitlines()[2]  # the best of each cloud, of these the worst
    assert goal_table(Document("", machine(), {})) == ""


def test_the_readme_lists_the_stages_as_they_are() -> None:
    text = README.read_text(encoding="utf-8")
    assert replaced(text, STAGES_BEGIN, STAGES_END, stage_table()) == text, "run python -m benchmarks stages --readme"


def test_text_is_put_between_marks() -> None:
    assert replaced("a <x> old </x> b", "<x>", "</x>", "new\n") == "a <x>\nnew\n</x> b"
    with pytest.raises(ValueError, match="has no '<x>' followed by '</x>'"):
        replaced("a </x> <x>", "<x>", "</x>", "new")


def test_the_command_line_on_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = tmp_path / "a.json", tmp_path / "b.json"
    write_document(first, document(0.2))
    write_document(second, document(0.3))
    assert main(["compare", str(first), str(second)]) == 0
    assert main(["compare", str(first), str(second), "--fail-above", "1.2"]) == 1
    assert "worse by more than 1.2: regnetv2, bf16, 2 threads, bag 0: detection, 1.50 times" in capsys.readouterr().out
    assert main(["table", str(first)]) == 0
    assert "| `regnetv2`, 25600 points" in capsys.readouterr().out
    assert main(["picture", str(first)]) == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert main(["table", str(tmp_path / "c.json")]) == 2
    assert "cannot be read" in capsys.readouterr().err
