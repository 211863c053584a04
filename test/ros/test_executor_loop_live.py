"""The whole loop by one command: it empties a small bin, and goes on where nodes are killed."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path

from live import NodeProcess, System, wait_for

LONG = 150.0
"""For the whole loop on a busy machine with nothing compiled yet [s]."""


def child(process: NodeProcess, program: str) -> int | None:
    """The process id of a node that the loop has started."""
    parent = process._process.pid
    for pid in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
        try:
            command = Path(f"/proc/{pid}/cmdline").read_bytes().decode()
        except OSError:  # it has just ended
            continue
        if f"regnet_ros.{program}\0" in command:
            return int(pid)
    return None


def kill(process: NodeProcess, program: str) -> None:
    """Kill a node, and wait until another one has taken its place."""
    victim = wait_for(lambda: child(process, program), f"a process of the {program}")
    os.kill(victim, signal.SIGKILL)
    process.wait_for_output(f"the {program} ended with code -9 and is started again")
    wait_for(lambda: child(process, program) not in (None, victim), f"another {program}")


def test_a_bin_is_emptied_though_nodes_are_killed(system: System) -> None:
    loop = system.start(
        "bin_picking", "--objects", "3", "--seed", "1", "--speed", "4", "--model", "antipodal", "--until-empty"
    )  # fmt: skip
    wait_for(lambda: "3 to pick, 0 placed" in loop.output, "the filled bin", LONG)
    kill(loop, "detector")
    kill(loop, "selector")
    wait_for(lambda: "2 to pick" in loop.output, "the first object to be picked", LONG)
    kill(loop, "executor")
    assert loop.wait(LONG) == 0, loop.output
    told = re.findall(r"^(\d) to pick, (\d) placed, (\d) beside the bins$", loop.output, flags=re.M)
    # Nobody put anything back: an executor that is started again finds the objects where they were.
    assert [row[0] for row in told] == sorted((row[0] for row in told), reverse=True)
    assert told[0] == ("3", "0", "0") and told[-1][0] == "0"
    placed, beside = (int(number) for number in told[-1][1:])
    assert placed + beside == 3 and placed >= 2  # a grasp in three may lose what it held
    assert "Traceback" not in loop.output


def test_a_node_that_refuses_its_parameters_ends_the_loop(system: System) -> None:
    loop = system.start("bin_picking", "--objects", "0", "--model", "no-such-model")
    assert loop.wait(60.0) == 1, loop.output
    assert "the detector does not start with these parameters" in loop.output
    assert "there is" in loop.output or "must be one of" in loop.output


def test_ctrl_c_ends_all(system: System) -> None:
    loop = system.start("bin_picking", "--objects", "0", "--model", "random", "--speed", "0")
    wait_for(lambda: "0 to pick" in loop.output, "the loop to run", LONG)
    parent = loop._process.pid
    nodes = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    assert len(nodes) >= 4
    loop.signal(signal.SIGINT)
    assert loop.wait(30.0) == 0, loop.output
    assert not any(Path(f"/proc/{pid}").exists() for pid in nodes)
