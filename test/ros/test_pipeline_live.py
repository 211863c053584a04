"""The three nodes together: bags replayed by the player, compared with the golden files of tools/make_golden.py.

The golden files come from the library alone, so that this also shows that nothing is lost or changed on the way through
messages. Tolerances: every count within 10 % (at least 2), the best grasp within 5 mm, 5 degrees, 3 mm of opening and
0.02 of quality of one of the ten best of the golden file, the selected score within 0.03. On the machine that made the
files everything agrees to the digits; elsewhere rounding may let equally good grasps change places.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from live import REPOSITORY, Inbox, NodeProcess, System, wait_for
from regnet_msgs.msg import GraspArray, SelectedGrasp
from sensor_msgs.msg import PointCloud2

from regnet_ros.conversions import grasps_from_messages

CONFIG = ["--params-file", str(REPOSITORY / "config" / "regnet.yaml")]
TOPIC = "/camera/depth/points"
GOLDEN = {path.stem: json.loads(path.read_text()) for path in (REPOSITORY / "test" / "bags" / "golden").glob("*.json")}
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
            system.start("detector", "--ros-args", *CONFIG),
            system.start("selector", "--ros-args", *CONFIG),
        ]
        for node in NODES:
            self.peer.wait_for_state(node, "active")
        names = ("/cloud", "/grasps")
        wait_for(
            lambda: all(self.peer.node.count_subscribers(name) == 2 for name in names), "the nodes to find each other"
        )

    def replay(self, bag: str, parameters: dict[str, Any]) -> list[GraspArray]:
        """The result of every cloud of the bag."""
        result = self.peer.set_parameters("preprocessor", parameters)
        assert result.successful, result.reason
        for inbox in (self.clouds, self.grasps, self.selected):
            inbox.clear()
        # Slowly, so that a busy machine keeps up: the nodes pass clouds over that they have no time for.
        options = ["--topics", TOPIC, "--wait-for-subscribers", "--rate", "0.4"]
        player = self.system.start("replay", str(REPOSITORY / "bags" / bag), *options)
        assert player.wait() == 0, player.output
        stamps = [cloud["stamp_ns"] for cloud in GOLDEN[bag]["clouds"]]
        return [self.grasps.wait(lambda m, s=stamp: nanoseconds(m) == s, what=f"result of {stamp}") for stamp in stamps]


def nanoseconds(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


@pytest.fixture(scope="module")
def pipeline(system: System) -> Pipeline:
    return Pipeline(system)


def test_the_golden_files_cover_the_bags() -> None:
    assert set(GOLDEN) == {path.parent.name for path in REPOSITORY.glob("bags/*/metadata.yaml")}
    assert len(GOLDEN) >= 5


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


@pytest.mark.parametrize("bag", sorted(GOLDEN))
def test_a_replayed_bag_gives_what_the_golden_file_says(pipeline: Pipeline, bag: str) -> None:
    golden = GOLDEN[bag]
    results = pipeline.replay(bag, golden["preprocessor_parameters"])
    for result, expected in zip(results, golden["clouds"], strict=True):
        assert result.header.frame_id == "world"
        assert abs(len(result.grasps) - expected["grasps"]) <= max(2, 0.1 * expected["grasps"])
        assert (result.reason != "") == (len(result.grasps) == 0) == expected["has_reason"]
        assert [step.name for step in result.steps] == expected["steps"]
        prepared = pipeline.clouds.wait(lambda m, r=result: m.header.stamp == r.header.stamp)
        assert abs(prepared.width - expected["prepared_points"]) <= 0.1 * expected["prepared_points"]
        if expected["best"]:
            assert_like_one_of(result, expected["best"])
            selected = pipeline.selected.wait(lambda m, r=result: m.header == r.header)
            assert selected.score == pytest.approx(expected["selected_score"], abs=0.03)
            assert selected.selected == result.grasps[selected.rank]


def assert_like_one_of(result: GraspArray, best: list[dict[str, Any]]) -> None:
    grasp = grasps_from_messages(result.grasps[:1])
    cos = np.cos(np.radians(5.0))
    similar = [
        np.linalg.norm(grasp.translation[0] - other["position"]) < 0.005
        and grasp.approach[0] @ other["approach"] > cos
        and abs(grasp.closing[0] @ other["closing"]) > cos
        and abs(grasp.width[0] - other["width"]) < 0.003
        and abs(grasp.quality[0] - other["quality"]) < 0.02
        for other in best
    ]
    assert any(similar), f"{result.grasps[0]} is like none of {best}"


def test_a_narrower_jaw_gives_narrower_grasps_of_the_same_bag(pipeline: Pipeline) -> None:
    assert pipeline.peer.set_parameter("detector", "gripper_width", 0.05).successful
    results = pipeline.replay("clutter_10", GOLDEN["clutter_10"]["preprocessor_parameters"])
    assert all(result.gripper.width == 0.05 for result in results)
    widths = [grasp.width for result in results for grasp in result.grasps]
    assert len(widths) > 0
    assert max(widths) <= 0.05
    assert pipeline.peer.set_parameter("detector", "gripper_width", 0.08).successful


def test_nothing_was_reported_that_should_not_be(pipeline: Pipeline) -> None:
    for process in pipeline.processes:
        assert process.alive
        assert "[ERROR]" not in process.output, process.output
        assert "there is no parameter" not in process.output, process.output
