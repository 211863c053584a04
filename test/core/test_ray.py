"""The same work on a Ray cluster of two nodes here, one of which is killed on the way."""

import operator
from collections.abc import Iterator
from pathlib import Path

import pytest

ray = pytest.importorskip("ray")
from ray.cluster_utils import Cluster  # noqa: E402

from regnet_core.data.generation.executors import RayExecutor  # noqa: E402
from regnet_core.data.generation.run import generate  # noqa: E402
from regnet_core.data.generation.settings import GenerationSettings  # noqa: E402
from regnet_core.data.labels.candidates import CandidateConfig  # noqa: E402
from regnet_core.data.storage.manifest import Manifest  # noqa: E402
from regnet_core.errors import InvalidInputError  # noqa: E402

SETTINGS = GenerationSettings(
    seed=3, scenes=8, widths=(0.08,), paper_views=1, dome_views=0, objects=8, shard_size=4,
    candidates=CandidateConfig(points=60),
)  # fmt: skip


class Here:
    """Runs everything in this process."""

    local = True

    def run(self, function, shared, items):  # type: ignore[no-untyped-def]
        return ((item, function(shared, item)) for item in items)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Cluster]:
    monkeypatch.setenv("RAY_health_check_period_ms", "500")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    two = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 100 * 2**20})
    yield two
    ray.shutdown()
    two.shutdown()


def test_a_node_that_dies_on_the_way_changes_nothing(cluster: Cluster, tmp_path: Path) -> None:
    other = cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20)
    cluster.wait_for_nodes()
    executor = RayExecutor(cluster.address)
    assert executor.workers == 2
    killed = []

    def kill_on_the_way(stage: str, done: int, total: int) -> None:
        if stage == "scenes" and done == 2 and not killed:
            killed.append(other)
            cluster.remove_node(other, allow_graceful=False)

    manifest = generate(tmp_path / "ray", SETTINGS, executor, progress=kill_on_the_way)
    assert killed and manifest.complete
    alone = generate(tmp_path / "here", SETTINGS, Here())
    assert Manifest.load(tmp_path / "ray").shards == alone.shards


def test_an_error_of_the_function_reaches_the_caller(cluster: Cluster) -> None:
    with pytest.raises(ZeroDivisionError):
        list(RayExecutor(cluster.address).run(operator.truediv, 1, [0]))


def test_no_cluster_is_a_clear_error() -> None:
    with pytest.raises(InvalidInputError, match=r"no Ray cluster answers at '127\.0\.0\.1:1'"):
        RayExecutor("127.0.0.1:1")
