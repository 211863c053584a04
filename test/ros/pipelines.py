"""The nodes together, with bags that the player replays."""

from __future__ import annotations

from typing import Any

import pytest
from golden import FILES, assert_alike, assert_count, tolerance
from live import REPOSITORY, Inbox, NodeProcess, System, wait_for
from regnet_msgs.msg import GraspArray, SelectedGrasp
from sensor_msgs.msg import PointCloud2

from regnet_ros.conversions import grasps_from_messages

CONFIG = ["--params-file", str(REPOSITORY / "config" / "regnet.yaml")]
TOPIC = "/camera/depth/points"
MODELS = sorted({model for model, _ in FILES})
# A result of the cloud before, detected again with another model, could be taken for one of a cloud with its stamp.
CHOSEN = ["-p", f"model:={MODELS[0]}", "-p", "device:=cpu", "-p", "redetect_on_change:=false"]
NODES = ("preprocessor", "detector", "selector")


class Pipeline:
    """The nodes with the committed configuration.

    Args:
        system: that they are processes of.
        programs: that they run in: one for each, as the launch file starts them with `apart`, or "pipeline" for two.
    """

    def __init__(self, system: System, programs: tuple[str, ...] = NODES) -> None:
        self.system, self.peer = system, system.peer
        self.clouds: Inbox = self.peer.listen(PointCloud2, "cloud")
        self.grasps: Inbox = self.peer.listen(GraspArray, "grasps")
        self.selected: Inbox = self.peer.listen(SelectedGrasp, "selected_grasp", latched=True)
        renamed = ["-r", f"points:={TOPIC}"]
        own = {"preprocessor": renamed, "detector": CHOSEN, "pipeline": [*renamed, *CHOSEN], "selector": []}
        self.processes: list[NodeProcess] = [
            system.start(program, "--ros-args", *CONFIG, *own[program]) for program in programs
        ]
        for node in NODES:
            self.peer.wait_for_state(node, "active")
        heard = {"/cloud": 1 if "pipeline" in programs else 2, "/grasps": 2}
        wait_for(
            lambda: all(self.peer.node.count_subscribers(name) == count for name, count in heard.items()),
            "the nodes to find each other",
        )

    def replay(self, model: str, bag: str) -> list[GraspArray]:
        """The result of every cloud of the bag."""
        golden = FILES[model, bag]
        self.set("detector", model=model)
        self.set("preprocessor", **golden["preprocessor_parameters"])
        for inbox in (self.clouds, self.grasps, self.selected):
            inbox.clear()
        # Slowly, so that a busy machine keeps up: the nodes pass clouds over that they have no time for.
        options = ["--topics", TOPIC, "--wait-for-subscribers", "--rate", "0.4"]
        player = self.system.start("replay", str(REPOSITORY / "bags" / bag), *options)
        assert player.wait() == 0, player.output
        stamps = [cloud["stamp_ns"] for cloud in golden["clouds"]]
        return [self.grasps.wait(lambda m, s=stamp: nanoseconds(m) == s, what=f"result of {stamp}") for stamp in stamps]

    def check(self, model: str, bag: str) -> None:
        """What comes of a replayed bag is what the golden file says."""
        results, limits = self.replay(model, bag), tolerance(model)
        for result, expected in zip(results, FILES[model, bag]["clouds"], strict=True):
            assert (result.header.frame_id, result.model, result.device) == ("world", model, "cpu")
            assert_count(len(result.grasps), expected["grasps"], limits)
            assert (result.reason != "") == (len(result.grasps) == 0) == expected["has_reason"]
            assert [step.name for step in result.steps] == expected["steps"]
            prepared = self.clouds.wait(lambda m, r=result: m.header.stamp == r.header.stamp)
            assert_count(prepared.width, expected["prepared_points"], limits)
            if expected["best"]:
                assert_alike(grasps_from_messages(result.grasps), expected["best"], limits)
                selected = self.selected.wait(lambda m, r=result: m.header == r.header)
                assert selected.score == pytest.approx(expected["selected_score"], abs=limits.score)
                assert selected.selected == result.grasps[selected.rank]

    def set(self, node: str, **parameters: Any) -> None:
        result = self.peer.set_parameters(node, parameters)
        assert result.successful, result.reason


def nanoseconds(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
