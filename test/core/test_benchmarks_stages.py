"""Stages of benchmarks: that their functions exist, how they are timed, and how much work they have."""

from __future__ import annotations

import importlib.util
import time
from contextlib import ExitStack

import numpy as np
import pytest

from benchmarks.errors import StageError
from benchmarks.patching import replace, resolve
from benchmarks.stage import Stage
from benchmarks.stages import ALL_STAGES, PROPOSALS, check_seen, detector_stages
from benchmarks.timer import StageTimer
from benchmarks.work import Work, ledger_flops, needed_work
from regnet_core import pointcloud, preprocessing, scene
from regnet_core.baselines.antipodal import AntipodalSampler
from regnet_core.nn.anchors import RESIDUALS
from regnet_core.nn.config import RefinementConfig
from regnet_core.nn.ledger import count_flops, layers
from regnet_core.nn.zoo import NETWORKS, REGNETV2


def _there(target: str) -> bool:
    """Whether the packages that a target needs are installed."""
    return not target.startswith(("regnet_ros", "benchmarks.messages")) or (
        importlib.util.find_spec("rclpy") is not None and importlib.util.find_spec("regnet_msgs") is not None
    )


@pytest.mark.parametrize(
    "target", [target for one in ALL_STAGES if one is not PROPOSALS for target in one.targets if _there(target)]
)
def test_every_function_of_the_table_of_stages_exists(target: str) -> None:
    assert callable(resolve(target).function)


def test_no_function_belongs_to_two_stages() -> None:
    targets = [target for one in ALL_STAGES for target in one.targets]
    assert len(targets) == len(set(targets))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("regnet_core.gone:work", "no module regnet_core.gone any more"),
        ("regnet_core.pointcloud:gone", "regnet_core.pointcloud has no function gone any more"),
        ("regnet_core.nn.heads:Gone.forward", "regnet_core.nn.heads has no Gone any more"),
        ("regnet_core.nn.heads:ScoreHead.gone", "has no function ScoreHead.gone any more"),
    ],
)
def test_a_function_that_vanished_is_named(name: str, message: str) -> None:
    with pytest.raises(StageError, match=message):
        resolve(name)


def test_a_stage_that_no_longer_runs_is_named() -> None:
    stages = detector_stages(type, network=True)
    seen = [name for one in stages for name in one.names(levels=3)]
    check_seen(stages, REGNETV2, seen, levels=3)
    seen.remove("propagation 2")
    with pytest.raises(StageError, match=r"'propagation 2' did not run: .*FeaturePropagation.forward; name in"):
        check_seen(stages, REGNETV2, seen, levels=3)
    check_seen(stages, None, [one.name for one in detector_stages(AntipodalSampler, network=False)], levels=0)


def test_a_replaced_function_is_replaced_wherever_it_was_imported_and_comes_back() -> None:
    original = pointcloud.voxel_downsample
    assert scene.voxel_downsample is preprocessing.voxel_downsample is original
    with ExitStack() as stack:
        replace(stack, resolve("regnet_core.pointcloud:voxel_downsample"), len)
        assert scene.voxel_downsample is preprocessing.voxel_downsample is pointcloud.voxel_downsample is len
    assert scene.voxel_downsample is preprocessing.voxel_downsample is pointcloud.voxel_downsample is original


def test_the_times_of_nested_stages_add_up() -> None:
    outer = Stage("outer", "preparation", "", ("regnet_core.pointcloud:validate_points",))
    inner = Stage("inner", "preparation", "", ("regnet_core.pointcloud:as_points",), numbered="down")
    observed = {"regnet_core.pointcloud:as_points": lambda arguments, result: {"points": len(result)}}
    points = np.zeros((1000, 3))
    with StageTimer([outer, inner], levels=2, observers=observed) as timer:
        for _ in range(2):
            pointcloud.validate_points(points)
        sample = timer.take()
        assert timer.take().stages == {}
    assert set(sample.stages) == {"outer", "inner 2", "inner 1"}
    whole, parts = sample.stages["outer"], [sample.stages["inner 2"], sample.stages["inner 1"]]
    assert whole.calls == 2 and all(part.calls == 1 and part.wall > 0.0 for part in parts)
    assert whole.inclusive == pytest.approx(whole.wall + sum(part.wall for part in parts))
    assert sample.counts == {"points": 2000.0}
    pointcloud.validate_points(points)  # no longer watched
    assert timer.take().stages == {}


def test_a_stage_inside_itself_is_not_counted_twice() -> None:
    both = Stage(
        "both", "preparation", "", ("regnet_core.pointcloud:validate_points", "regnet_core.pointcloud:as_points")
    )
    with StageTimer([both]) as timer:
        start = time.perf_counter()
        pointcloud.validate_points(np.zeros((10, 3)))
        elapsed = time.perf_counter() - start
        entry = timer.take().stages["both"]
    assert entry.calls == 2
    assert entry.wall == pytest.approx(entry.inclusive)
    assert entry.inclusive <= elapsed


def test_an_observer_that_no_longer_fits_is_an_error() -> None:
    one = Stage("one", "preparation", "", ("regnet_core.pointcloud:as_points",))
    observed = {"regnet_core.pointcloud:as_points": lambda arguments, result: {"levels": len(result.levels)}}
    with StageTimer([one], observers=observed), pytest.raises(StageError, match="takes or gives something else"):
        pointcloud.as_points(np.zeros((10, 3)))
    with pytest.raises(StageError, match="must be the target of a stage"):
        StageTimer([one], observers={"regnet_core.pointcloud:voxel_downsample": lambda arguments, result: {}})


@pytest.mark.parametrize("name", NETWORKS)
def test_the_ledgers_operations_all_belong_to_stages(name: str) -> None:
    assert sum(ledger_flops(NETWORKS[name]).values()) == count_flops(NETWORKS[name])


def full_counts() -> dict[str, float]:
    """What would be noted of a cloud in which every slot of the paper's network is taken."""
    counts: dict[str, float] = {"points": 25_600, "scored": 25_600, "regions": 768, "feature bytes": 2}
    counts["candidates"] = 768 * 4
    for number, abstraction in enumerate(REGNETV2.abstractions, 1):
        counts[f"centroids {number}"] = abstraction.centroids
        counts[f"neighbours {number}"] = abstraction.centroids * abstraction.neighbours
    return {**counts, "closing points": 768 * 4 * 64, "region points": 768 * 256}


def test_a_full_cloud_needs_what_the_ledger_counts_but_for_what_is_computed_once() -> None:
    needed, nominal = needed_work(REGNETV2, full_counts()), dict.fromkeys(ledger_flops(REGNETV2), 0.0)
    names = {"score": "score head", "regions": "grasp heads"}
    for layer in layers(REGNETV2):
        nominal[names.get(layer.stage, layer.stage)] += 2.0 * layer.rows * layer.inputs * layer.outputs
    for stage in ("score head", "grasp heads", "refinement", "abstraction 1"):
        # The width of abstraction 1 goes once for each point into its layer, not once for each neighbour.
        once = 2.0 * (5120 * 64 - 25_600) * 128 if stage == "abstraction 1" else 0.0
        assert needed[stage].flops == pytest.approx(nominal[stage] - once, rel=1e-12)
    # 256 features: at 5120 points below instead of at 1024 x 64 neighbours.
    once = 2.0 * (1024 * 64 - 5120) * 256 * 256
    assert needed["abstraction 2"].flops == pytest.approx(nominal["abstraction 2"] - once)
    # 512 features: at 5120 centroids instead of at 25600 points, and 3 x 256 for interpolating what comes of them.
    once = 2.0 * (25_600 - 5120) * 512 * 256 - 2.0 * 3 * 25_600 * 256
    assert needed["propagation 1"].flops == pytest.approx(nominal["propagation 1"] - once)


def test_the_bytes_of_pooling_regions_are_those_gathered() -> None:
    work = needed_work(REGNETV2, full_counts())["regions"]
    assert work == Work(0.0, 768 * 256 * (2 * 256 + 8) + 768 * 2 * 256)


def test_work_counts_the_features_that_come_with_the_points_of_closing_areas_once() -> None:
    counts = {"points": 1000.0, "closing points": 500.0, "candidates": 10.0, "feature bytes": 4.0}
    config = REGNETV2.replace(refinement=RefinementConfig(channels=(64, 32, 16), fusion=(8,), point_features=True))
    # 256 features at 1000 points; x, y, z and the width at 500 neighbours; then 16 and 256 features of 10 candidates.
    expected = 2.0 * (1000 * 256 * 64 + 500 * (4 * 64 + 64 * 32 + 32 * 16))
    expected += 2.0 * 10 * ((16 + 256) * 8 + 8 * (RESIDUALS + 2))
    assert needed_work(config, counts)["refinement"].flops == pytest.approx(expected)
