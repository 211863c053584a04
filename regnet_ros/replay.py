"""The program `replay`: plays an MCAP bag where rosbag2 is not installed, from the messages as they were recorded."""

from __future__ import annotations

import argparse
import contextlib
import math
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from rclpy._rclpy_pybind11 import InvalidHandle, RCLError
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time
from rosgraph_msgs.msg import Clock

from regnet_core.errors import BagError, InvalidInputError
from regnet_ros.bag import Bag, BagMessage, message_class
from regnet_ros.transport import make_room_for_clouds

_CLOCK_PERIOD = 0.01
_NAP = 0.05
"""Longest sleep [s]: a signal is noticed so soon."""
_SHORTEST_LOOP = 1.0
"""A bag of a single message is played again after so long, at the recorded speed [s]."""
_PATIENCE = 6.0
"""How long to wait for subscribers unless told otherwise [s]; what is published before they are found is lost.

Fast DDS announces a new participant at once and then every 3 s: where the first announcements are lost, discovery takes
that long.
"""
_HANDSHAKE = 0.2
"""How long a subscriber that was found may need to find the publisher [s]."""
_KEPT = 512 << 20
"""Messages of so many bytes are kept in memory to be played again, decompressed once."""
_LAST_WORDS = 5.0
"""How long to wait at the end for reliable subscribers to have everything [s]."""


@dataclass(frozen=True)
class Options:
    """What to play and how."""

    bag: Path
    rate: float = 1.0
    """How many times faster than recorded; infinite: as fast as reliable subscribers take the messages."""
    loop: bool = False
    clock: bool = False
    topics: tuple[str, ...] = ()
    """Only these topics; all when empty."""
    remap: tuple[tuple[str, str], ...] = ()
    """Pairs of a recorded and a published topic."""
    patience: float = 0.0
    """How long to wait for subscribers before playing [s]."""


class Player:
    """Publishes the messages of a bag."""

    def __init__(self, node: Node, options: Options) -> None:
        """Create the publishers; a topic whose message package is not installed is left out, with a notice.

        Raises:
            BagError: the bag cannot be read, lacks a wanted topic, or holds nothing that can be played.
        """
        self._node, self._options = node, options
        self._bag = Bag(options.bag)
        self._publishers: dict[str, Any] = {}
        self._clock = node.create_publisher(Clock, "/clock", 10) if options.clock else None
        self._kept: list[BagMessage] = []
        self._all_kept = False
        renamed = dict(options.remap)
        for name in self._wanted([*options.topics, *renamed]):
            topic = self._bag.topics[name]
            kind = message_class(topic.type_name)
            if kind is None:
                package = topic.type_name.partition("/")[0]
                print(f"skipping {name} ({topic.type_name}): the package {package} is not installed here", flush=True)
                continue
            self._publishers[name] = node.create_publisher(kind, renamed.get(name, name), topic.qos)
        if not self._publishers:
            raise BagError(f"the bag '{options.bag}' holds nothing that can be played here")

    def play(self) -> int:
        """Play until the end, or for ever in a loop, or until the context shuts down; the number of messages."""
        self._wait_for_subscribers()
        start, count = time.monotonic(), self._play_once()
        while self._options.loop and self._running:
            self._rest_until(start + _SHORTEST_LOOP / self._options.rate)
            start = time.monotonic()
            count += self._play_once()
        deadline = Duration(seconds=_LAST_WORDS)
        for publisher in self._publishers.values():
            if self._running:
                publisher.wait_for_all_acked(deadline)
        return count

    @property
    def _running(self) -> bool:
        return self._node.context.ok()

    def _play_once(self) -> int:
        start, first, count = time.monotonic(), None, 0
        for message in self._messages():
            first = message.time_ns if first is None else first
            self._sleep_until(start + (message.time_ns - first) / 1e9 / self._options.rate, message.time_ns)
            if not self._running:
                return count
            publisher = self._publishers[message.topic]
            publisher.publish(message.data)
            if math.isinf(self._options.rate):  # otherwise the queue of the publisher would overflow
                publisher.wait_for_all_acked(Duration(seconds=1.0))
            count += 1
        return count

    def _messages(self) -> Iterator[BagMessage]:
        """Those of the bag; in a loop from memory, once they have been read, where there are not too many."""
        if self._all_kept:
            yield from self._kept
            return
        self._kept.clear()
        size, small = 0, self._options.loop
        for message in self._bag.messages(list(self._publishers)):
            yield message
            size += len(message.data)
            small = small and size <= _KEPT
            if small:
                self._kept.append(message)
            else:
                self._kept.clear()
        self._all_kept = small

    def _sleep_until(self, due: float, time_ns: int) -> None:
        """Sleep until ``due``; publish the clock of the bag, which reads ``time_ns`` then."""
        while self._running:
            left = due - time.monotonic()
            if self._clock is not None:
                ahead = max(left, 0.0) * self._options.rate if math.isfinite(self._options.rate) else 0.0
                self._clock.publish(Clock(clock=Time(nanoseconds=time_ns - round(1e9 * ahead)).to_msg()))
            if left <= 0.0:
                return
            time.sleep(min(left, _CLOCK_PERIOD if self._clock is not None else _NAP))

    def _rest_until(self, due: float) -> None:
        while self._running and (left := due - time.monotonic()) > 0.0:
            time.sleep(min(left, _NAP))

    def _wait_for_subscribers(self) -> None:
        """Until every topic that was asked for by name, or else any topic, has a subscriber."""
        named = [self._publishers[name] for name in self._options.topics if name in self._publishers]
        deadline = time.monotonic() + self._options.patience
        while self._running and time.monotonic() < deadline:
            found = [p.get_subscription_count() > 0 for p in named or self._publishers.values()]
            if all(found) if named else any(found):
                self._rest_until(time.monotonic() + _HANDSHAKE)
                return
            time.sleep(_NAP)
        if self._options.patience > 0.0 and self._running:
            print("no subscriber came; playing anyway", flush=True)

    def _wanted(self, named: list[str]) -> list[str]:
        unknown = [name for name in named if name not in self._bag.topics]
        if unknown:
            raise BagError(
                f"the bag '{self._options.bag}' has no topic {', '.join(unknown)}; it has "
                f"{', '.join(sorted(self._bag.topics)) or 'none'}"
            )
        return sorted(self._options.topics or self._bag.topics)


def split_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Our own arguments and those between ``--ros-args`` and ``--``. rclpy is not shown ours: it would take a renaming
    of ours, old:=new, for a deprecated one of its own."""
    own: list[str] = []
    ros: list[str] = []
    inside = False
    for argument in arguments:
        if argument == "--ros-args":
            inside = True
        if inside:
            ros.append(argument)
            inside = argument != "--"
        else:
            own.append(argument)
    return own, ros


def parse(arguments: Sequence[str]) -> Options:
    """The options of a command line without ROS arguments; ends the process with code 2 where it makes no sense."""
    parser = argparse.ArgumentParser(prog="replay", description="Play an MCAP bag with its recorded QoS.")
    parser.add_argument("bag", type=Path, metavar="BAG", help="folder with metadata.yaml, or one .mcap file")
    parser.add_argument("--rate", type=_rate, default=1.0, help="times the recorded speed, or 'max' (default: 1.0)")
    parser.add_argument("--loop", action="store_true", help="start again at the end")
    parser.add_argument("--clock", action="store_true", help="publish the bag's time on /clock (for use_sim_time)")
    parser.add_argument("--topics", nargs="+", default=[], metavar="TOPIC", help="play only these topics")
    parser.add_argument(
        "--remap", nargs="+", type=_renaming, default=[], metavar="OLD:=NEW", help="publish a topic under another name"
    )
    parser.add_argument(
        "--wait-for-subscribers",
        nargs="?",
        type=_seconds,
        const=math.inf,
        default=_PATIENCE,
        metavar="SECONDS",
        help="begin once the topics of --topics, or else any topic, have a subscriber; wait so long, or for ever when "
        f"no number is given (without this option: {_PATIENCE:g} s)",
    )
    given = parser.parse_args(list(arguments))
    return Options(
        given.bag,
        given.rate,
        given.loop,
        given.clock,
        tuple(given.topics),
        tuple(given.remap),
        given.wait_for_subscribers,
    )


def main(args: Sequence[str] | None = None) -> int:
    """Play a bag; the exit code: 0 at the end or on a signal, 2 where it cannot be played."""
    own, ros = split_arguments(sys.argv[1:] if args is None else args)
    options = parse(own)
    stops: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):  # rclpy's own handlers shut the context down and call these
        signal.signal(number, lambda received, _: stops.append(received))
    make_room_for_clouds()
    try:
        rclpy.init(args=["replay", *ros])
        node = rclpy.create_node("replay", start_parameter_services=False)
        if stops:
            rclpy.try_shutdown()
        start = time.monotonic()
        count = Player(node, options).play()
        print(f"played {count} messages in {time.monotonic() - start:.1f} s", flush=True)
    except (InvalidInputError, RCLError, InvalidHandle) as error:
        if stops:
            return 0
        print(f"replay: {error}", file=sys.stderr)
        return 2
    finally:
        with contextlib.suppress(RCLError, InvalidHandle):
            rclpy.try_shutdown()
    return 0


def _rate(text: str) -> float:
    rate = math.inf if text == "max" else float(text)
    if not rate > 0.0:
        raise argparse.ArgumentTypeError(f"must be a positive number or 'max', got '{text}'")
    return rate


def _seconds(text: str) -> float:
    seconds = float(text)
    if not seconds >= 0.0:
        raise argparse.ArgumentTypeError(f"must be a number of seconds, got '{text}'")
    return seconds


def _renaming(text: str) -> tuple[str, str]:
    old, arrow, new = text.partition(":=")
    if not (old and arrow and new):
        raise argparse.ArgumentTypeError(f"must look like /old:=/new, got '{text}'")
    return old, new


if __name__ == "__main__":
    sys.exit(main())
