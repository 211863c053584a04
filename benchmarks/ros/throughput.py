"""How many clouds of a replayed bag become GraspArrays in a second, and what the nodes' processes use meanwhile."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.clouds import bag_topic, read_cloud
from benchmarks.errors import BenchmarkError
from benchmarks.growth import MemorySample, memory_record
from benchmarks.machine import LoadMeter
from benchmarks.models import ModelChoice, choose_model, ready_model
from benchmarks.records import MemoryRecord, NodeUse, ThroughputRecord
from benchmarks.ros.system import NodeProcess, NodeSystem, check_ros, ros_environment
from regnet_core.checks import check_range
from regnet_core.io.bags import read_bag_clouds

_SHORTEST_LOOP = 1.0
"""Of a bag that is played at the recorded speed [s]: regnet_ros/replay.py."""
_LOOK = 5.0
"""From one look at the memory to the next [s]."""


@dataclass(frozen=True)
class ThroughputSettings:
    """What to measure.

    Raises:
        InvalidInputError: a number is out of range.
    """

    model: str
    """As ``choose_model`` takes it."""
    bag: Path = Path("bags/tilted_depth_only")
    offered: float = 20.0
    """Clouds published in a second."""
    seconds: float = 20.0
    """How long to watch, after a few seconds that do not count."""
    threads: int = 2
    """The detector's parameter; 0: one for each core."""
    at_a_time: int = 1
    """The detector's parameter."""
    width: float = 0.08
    """Of the gripper [m]."""
    weights_seed: int = 0
    warm_up: float = 3.0
    """[s]"""

    def __post_init__(self) -> None:
        check_range("offered", self.offered, 0.1, 1000.0, "Hz")
        check_range("seconds", self.seconds, 1.0, 1e6, "s")
        check_range("warm_up", self.warm_up, 0.1, 1e3, "s")
        check_range("threads", self.threads, 0, 1024)
        check_range("at_a_time", self.at_a_time, 1, 16)


class _Playing(NamedTuple):
    choice: ModelChoice
    system: NodeSystem
    player: NodeProcess


def replay_rate(times_ns: list[int], offered: float) -> float:
    """How many times faster than recorded a looping bag has to be played.

    Args:
        times_ns: the stamps of its clouds, ascending.
        offered: how many clouds a second are wanted.
    """
    span = (times_ns[-1] - times_ns[0]) / 1e9
    # The first cloud of a loop comes together with the last one of the loop before, unless the bag is very short.
    return offered * max(span, _SHORTEST_LOOP) / len(times_ns)


def received_rate(status: Sequence[Mapping[str, Any]]) -> float:
    """Clouds a second that the preprocessor received, by what it counted in its first and its last diagnostics."""
    counts = [(one["time"], int(one["values"]["received"])) for one in status if one["node"] == "preprocessor"]
    if len(counts) < 2 or counts[-1][0] <= counts[0][0]:
        raise BenchmarkError(f"the preprocessor published {len(counts)} diagnostics: watch for a few seconds more")
    return (counts[-1][1] - counts[0][1]) / float(counts[-1][0] - counts[0][0])


def measure_throughput(settings: ThroughputSettings, say: Callable[[str], None] = print) -> ThroughputRecord:
    """Replay a bag to the nodes and count results.

    Raises:
        BenchmarkError: there is no ROS, a node does not start, or nothing arrives.
    """
    with _playing(settings, say) as (choice, system, player):
        before = {name: node.cpu_seconds() for name, node in system.nodes.items()}
        system.receiver.ask("diagnostics")
        start, meter = time.monotonic(), LoadMeter([player.pid, *system.pids])
        seen = system.receiver.ask("watch", seconds=settings.seconds)
        elapsed, others = time.monotonic() - start, meter.others()
        if seen["count"] < 2:
            raise BenchmarkError(f"{seen['count']} GraspArrays arrived in {settings.seconds:g} s: too few for a rate")
        use = tuple(
            NodeUse(name, (node.cpu_seconds() - before[name]) / elapsed, node.resident_bytes(), node.peak_bytes())
            for name, node in system.nodes.items()
        )
        heard = system.receiver.ask("diagnostics")["status"]
    return ThroughputRecord(
        model=choice.name,
        weights=choice.weights,
        threads=settings.threads,
        bag=settings.bag.name,
        offered=settings.offered,
        received=received_rate(heard),
        sustained=(seen["count"] - 1) / seen["span"],
        seconds=elapsed,
        nodes=use,
        others=others,
        at_a_time=settings.at_a_time,
        detection=seen["detection"],
    )


def measure_node_memory(
    settings: ThroughputSettings, detections: int, allowed: float, say: Callable[[str], None] = print
) -> tuple[MemoryRecord, ...]:
    """Replay a bag until so many results have arrived, and look at the memory of every node's process.

    Args:
        settings: what to replay to which model.
        detections: how many results to wait for.
        allowed: growth over 10,000 detections that counts as none [bytes].
        say: receives a line now and then.

    Raises:
        BenchmarkError: there is no ROS, a node does not start, or nothing arrives.
    """
    with _playing(settings, say) as (choice, system, _):
        samples: dict[str, list[MemorySample]] = {name: [] for name in system.nodes}
        start, first, done = time.monotonic(), None, 0
        while done < detections:
            seen = system.receiver.ask("watch", seconds=_LOOK)
            if seen["count"] == 0:
                raise BenchmarkError(f"no GraspArray arrived in {_LOOK:g} s, after {done} of {detections}")
            first = seen["total"] - seen["count"] if first is None else first
            done = seen["total"] - first
            for name, node in system.nodes.items():
                node.check_alive()
                samples[name].append(MemorySample(done, node.resident_bytes(), node.peak_bytes()))
            say(f"{done} of {detections} detections through the nodes")
        seconds = time.monotonic() - start
    return tuple(
        memory_record(choice.name, choice.weights, name, found, allowed, seconds) for name, found in samples.items()
    )


@contextmanager
def _playing(
    settings: ThroughputSettings, say: Callable[[str], None]
) -> Iterator[tuple[ModelChoice, NodeSystem, NodeProcess]]:
    """The nodes, with a bag being played to them for some seconds already."""
    check_ros()
    choice, topic = choose_model(settings.model, settings.weights_seed), bag_topic(settings.bag)
    times = [cloud.stamp_ns for cloud in islice(read_bag_clouds(settings.bag, topic), 10_000)]
    rate = replay_rate(times, settings.offered)
    say(f"replaying {settings.bag.name} with {settings.offered:g} clouds/s to {choice.name}")
    with ExitStack() as stack:
        environment = stack.enter_context(ros_environment())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        model = ready_model(choice, folder, settings.weights_seed)
        pose = read_cloud(str(settings.bag)).T_target_cloud
        system = NodeSystem(stack, environment, model, settings.threads, settings.width, pose, settings.at_a_time)
        player = stack.enter_context(system.replay(settings.bag, topic, rate))
        system.wait_until(lambda: system.receiver.ask("watch", seconds=0.2)["total"] > 0, "the first GraspArray")
        system.receiver.ask("watch", seconds=settings.warm_up)
        yield _Playing(choice, system, player)
        player.check_alive()
