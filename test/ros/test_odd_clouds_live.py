"""The table of malformed and unusual clouds, sent to running nodes: each answers clearly, lives, and goes on."""

from __future__ import annotations

import re

import pytest
from builtin_interfaces.msg import Time
from clouds import ODD_CLOUDS, SCENE, OddCloud, cloud, huge_cloud
from diagnostic_msgs.msg import DiagnosticStatus
from live import Inbox, NodeProcess, Peer, System, values_of
from regnet_msgs.msg import GraspArray, SelectedGrasp
from regnet_msgs.srv import DetectGrasps
from sensor_msgs.msg import PointCloud2

NODES = {"preprocessor": "voxel_size", "detector": "gripper_width", "selector": "policy"}


class Chain:
    """The three nodes: `points` feeds the preprocessor, `cloud` the detector, whose grasps feed the selector."""

    def __init__(self, system: System) -> None:
        self.peer: Peer = system.peer
        self.prepared: Inbox = self.peer.listen(PointCloud2, "prepared")
        self.grasps: Inbox = self.peer.listen(GraspArray, "grasps")
        self.selected: Inbox = self.peer.listen(SelectedGrasp, "selected_grasp", latched=True)
        self.processes: list[NodeProcess] = [
            system.start_node("preprocessor", remap={"cloud": "prepared"}),
            system.start_node("detector", model="antipodal", target_frame="world"),
            system.start_node("selector"),
        ]
        self._stamp = 1000

    def stamped(self, message: PointCloud2) -> PointCloud2:
        """The message with a stamp of its own, unless it is meant to have none."""
        if message.header.stamp.sec != 0:
            self._stamp += 1
            message.header.stamp = Time(sec=self._stamp)
        return message

    def send(self, message: PointCloud2, topic: str) -> None:
        for inbox in (self.prepared, self.grasps, self.selected, self.peer.diagnostics):
            inbox.clear()
        self.peer.publisher(PointCloud2, topic).publish(message)

    def assert_all_answer(self) -> None:
        for process in self.processes:
            assert process.alive, process.output
            assert self.peer.get_parameter(process.program, NODES[process.program]) is not None


@pytest.fixture(scope="module")
def chain(system: System) -> Chain:
    return Chain(system)


@pytest.mark.parametrize("odd", ODD_CLOUDS, ids=lambda odd: odd.name)
def test_the_detector_answers_every_cloud(chain: Chain, odd: OddCloud) -> None:
    message = chain.stamped(odd.make())
    chain.send(message, "cloud")
    result = chain.grasps.wait(lambda array: array.header == message.header, what="GraspArray")
    if odd.detector:
        assert len(result.grasps) == 0
        assert re.search(odd.detector, result.reason), result.reason
        chain.peer.wait_for_status("detector", lambda status: re.search(odd.detector, status.message) is not None)
    else:
        assert len(result.grasps) > 0
        assert result.reason == ""
        assert chain.selected.wait().header == message.header
    chain.assert_all_answer()


@pytest.mark.parametrize("odd", ODD_CLOUDS, ids=lambda odd: odd.name)
def test_the_preprocessor_answers_every_cloud(chain: Chain, odd: OddCloud) -> None:
    message = chain.stamped(odd.make())
    chain.send(message, "points")
    if odd.preprocessor:
        status = chain.peer.wait_for_status(
            "preprocessor", lambda s: re.search(odd.preprocessor, s.message) is not None
        )
        assert status.level in (DiagnosticStatus.WARN, DiagnosticStatus.ERROR)
    if not odd.decoder and "frame" not in odd.name:
        assert chain.prepared.wait().header == message.header
    chain.assert_all_answer()


def test_a_huge_cloud_is_worked_on(chain: Chain) -> None:
    message = chain.stamped(huge_cloud(1_000_000))
    chain.send(message, "cloud")
    result = chain.grasps.wait(lambda array: array.header == message.header, what="GraspArray")
    assert len(result.grasps) > 0
    assert result.steps[0].kept == 1_000_000
    chain.assert_all_answer()


@pytest.mark.parametrize("odd", [odd for odd in ODD_CLOUDS if odd.decoder][::5], ids=lambda odd: odd.name)
def test_the_service_refuses_a_malformed_cloud(chain: Chain, odd: OddCloud) -> None:
    response = chain.peer.call(DetectGrasps, "detect_grasps", DetectGrasps.Request(cloud=odd.make()))
    assert not response.success
    assert re.search(odd.decoder, response.message), response.message


def test_after_all_of_them_a_good_cloud_gives_grasps_and_a_selection(chain: Chain) -> None:
    message = chain.stamped(cloud(SCENE))
    chain.send(message, "points")
    prepared = chain.prepared.wait()
    chain.send(prepared, "cloud")
    result = chain.grasps.wait(lambda array: array.header == message.header)
    assert len(result.grasps) > 0
    assert chain.selected.wait().header == message.header
    chain.peer.diagnostics.clear()
    for node in NODES:
        status = chain.peer.wait_for_status(node)
        assert status.level == DiagnosticStatus.OK, status.message
    detector = values_of(chain.peer.wait_for_status("detector"))
    assert int(detector["received"]) >= len(ODD_CLOUDS)
    assert int(detector["failed"]) > 10
    assert float(detector["latency detect [ms]"]) > 0.0
