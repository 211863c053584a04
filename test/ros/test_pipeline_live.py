"""The three nodes together: bags replayed by the player, compared with the golden files of tools/make_golden.py.

The golden files come from the library alone, so that this also shows that nothing is lost or changed on the way through
messages. Every model with a folder of golden files is compared, all with the same nodes; golden.py has the tolerances.
"""

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
    """The nodes with the committed configuration, as the launch file starts them."""

    def __init__(self, system: System) -> None:
        self.system, self.peer = system, system.peer
        self.clouds: Inbox = self.peer.listen(PointCloud2, "cloud")
        self.grasps: Inbox = self.peer.listen(GraspArray, "grasps")
        self.selected: Inbox = self.peer.listen(SelectedGrasp, "selected_grasp", latched=True)
        self.processes: list[NodeProcess] = [
            system.start("preprocessor", "--ros-args", *CONFIG, "-r", f"points:={TOPIC}"),
            system.start("detector", "--ros-args", *CONFIG, *CHOSEN),
            system.start("selector", "--ros-args", *CONFIG),
        ]
        for node in NODES:
            self.peer.wait_for_state(node, "active")
        names = ("/cloud", "/grasps")
        wait_for(
            lambda: all(self.peer.node.count_subscribers(name) == 2 for name in names), "the nodes to find each other"
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

    def set(self, node: str, **parameters: Any) -> None:
        result = self.peer.set_parameters(node, parameters)
        assert result.successful, result.reason


def nanoseconds(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


@pytest.fixture(scope="module")
def pipeline(system: System) -> Pipeline:
    return Pipeline(system)


def test_the_nodes_can_be_listed_from_another_process(pipeline: Pipeline) -> None:
    node = pipeline.peer.node
    assert wait_for(lambda: set(NODES) <= set(node.get_node_names()), "the names of the nodes")
    wanted = {"/detect_grasps", "/select_grasp"}
    wait_for(lambda: wanted <= {name for name, _ in node.get_service_names_and_types()}, "the services")
    topics = dict(node.get_topic_names_and_types())
    assert topics["/grasps"] == ["regnet_msgs/msg/GraspArray"]
    assert topics["/selected_grasp"] == ["regnet_msgs/msg/SelectedGrasp"]
    assert topics["/cloud"] == ["sensor_msgs/msg/PointCloud2"]
    services = dict(node.get_service_names_and_types())
    assert services["/detect_grasps"] == ["regnet_msgs/srv/DetectGrasps"]
    assert services["/select_grasp"] == ["regnet_msgs/srv/SelectGrasp"]


@pytest.mark.parametrize(("model", "bag"), sorted(FILES))
def test_a_replayed_bag_gives_what_the_golden_file_says(pipeline: Pipeline, model: str, bag: str) -> None:
    results, limits = pipeline.replay(model, bag), tolerance(model)
    for result, expected in zip(results, FILES[model, bag]["clouds"], strict=True):
        assert (result.header.frame_id, result.model, result.device) == ("world", model, "cpu")
        assert_count(len(result.grasps), expected["grasps"], limits)
        assert (result.reason != "") == (len(result.grasps) == 0) == expected["has_reason"]
        assert [step.name for step in result.steps] == expected["steps"]
        prepared = pipeline.clouds.wait(lambda m, r=result: m.header.stamp == r.header.stamp)
        assert_count(prepared.width, expected["prepared_points"], limits)
        if expected["best"]:
            assert_alike(grasps_from_messages(result.grasps), expected["best"], limits)
            selected = pipeline.selected.wait(lambda m, r=result: m.header == r.header)
            assert selected.score == pytest.approx(expected["selected_score"], abs=limits.score)
            assert selected.selected == result.grasps[selected.rank]


@pytest.mark.parametrize("model", MODELS)
def test_a_narrower_jaw_gives_narrower_grasps_of_the_same_bag(pipeline: Pipeline, model: str) -> None:
    pipeline.set("detector", gripper_width=0.05)
    results = pipeline.replay(model, "clutter_10")
    assert all(result.gripper.width == 0.05 for result in results)
    widths = [grasp.width for result in results for grasp in result.grasps]
    assert len(widths) > 0
    assert max(widths) <= 0.05
    pipeline.set("detector", gripper_width=0.08)


def test_nothing_was_reported_that_should_not_be(pipeline: Pipeline) -> None:
    for process in pipeline.processes:
        assert process.alive
        assert "[ERROR]" not in process.output, process.output
        assert "there is no parameter" not in process.output, process.output
