"""The program `pipeline`, two nodes in one process: what they do is what they do as programs of their own."""

from __future__ import annotations

import pytest
from clouds import SCENE, cloud
from golden import FILES
from lifecycle_msgs.msg import Transition
from live import System, TimeExpiredError, values_of
from pipelines import MODELS, TOPIC, Pipeline
from regnet_msgs.msg import GraspArray
from sensor_msgs.msg import PointCloud2


@pytest.fixture(scope="module")
def pipeline(system: System) -> Pipeline:
    return Pipeline(system, ("pipeline", "selector"))


class Camera:
    """Sends clouds that need no transform."""

    stamp = 100

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline

    def send(self) -> PointCloud2:
        Camera.stamp += 1
        message = cloud(SCENE, stamp=Camera.stamp)
        self.pipeline.peer.publisher(PointCloud2, TOPIC).publish(message)
        return message

    def result(self) -> GraspArray:
        message = self.send()
        return self.pipeline.grasps.wait(lambda array: array.header == message.header, what="GraspArray")


@pytest.fixture
def camera(pipeline: Pipeline) -> Camera:
    pipeline.set("preprocessor", sensor_pose=[])
    pipeline.grasps.clear()
    pipeline.clouds.clear()
    return Camera(pipeline)


def test_a_replayed_bag_gives_what_the_golden_file_says(pipeline: Pipeline) -> None:
    model = MODELS[0]
    pipeline.check(model, min(bag for name, bag in FILES if name == model))


def test_the_width_set_from_another_process_is_that_of_the_next_array(camera: Camera) -> None:
    for width in (0.05, 0.08):
        camera.pipeline.set("detector", gripper_width=width)
        assert camera.result().gripper.width == width


def test_the_prepared_cloud_is_published_for_those_who_listen(camera: Camera) -> None:
    header = camera.result().header
    prepared = camera.pipeline.clouds.wait(lambda message: message.header == header)
    assert 0 < prepared.width <= len(SCENE)


def test_the_states_of_the_nodes_are_their_own(camera: Camera) -> None:
    peer = camera.pipeline.peer
    assert peer.change_state("detector", Transition.TRANSITION_DEACTIVATE)
    header = camera.send().header
    camera.pipeline.clouds.wait(lambda message: message.header == header)
    with pytest.raises(TimeExpiredError):
        camera.pipeline.grasps.wait(timeout=0.5)
    assert peer.change_state("detector", Transition.TRANSITION_CLEANUP)
    header = camera.send().header
    camera.pipeline.clouds.wait(lambda message: message.header == header)
    assert peer.change_state("detector", Transition.TRANSITION_CONFIGURE)
    assert peer.change_state("detector", Transition.TRANSITION_ACTIVATE)
    assert len(camera.result().grasps) > 0
    assert peer.change_state("preprocessor", Transition.TRANSITION_DEACTIVATE)
    camera.send()
    with pytest.raises(TimeExpiredError):
        camera.pipeline.grasps.wait(lambda array: array.header.stamp.sec == Camera.stamp, timeout=0.5)
    assert peer.change_state("preprocessor", Transition.TRANSITION_ACTIVATE)
    assert len(camera.result().grasps) > 0


def test_each_node_reports_its_own_health(camera: Camera) -> None:
    camera.result()
    for node, stage in (("preprocessor", "latency prepare [ms]"), ("detector", "latency detect [ms]")):
        values = values_of(camera.pipeline.peer.wait_for_status(node, lambda s, stage=stage: stage in values_of(s)))
        assert values["state"] == "active"


def test_the_detector_may_be_brought_up_first(system: System) -> None:
    peer = system.peer
    grasps = peer.listen(GraspArray, "late/grasps")
    process = system.start(
        "pipeline", "--ros-args", "-r", "__ns:=/late", "-p", "autostart:=false", "-p", "model:=antipodal"
    )
    peer.wait_for_state("late/detector", "unconfigured")
    for node in ("late/detector", "late/preprocessor"):
        assert peer.change_state(node, Transition.TRANSITION_CONFIGURE), process.output
        assert peer.change_state(node, Transition.TRANSITION_ACTIVATE), process.output
        assert peer.state(node) == "active"
    peer.publisher(PointCloud2, "late/points").publish(cloud(SCENE, stamp=7))
    assert len(grasps.wait(lambda array: array.header.stamp.sec == 7, what="GraspArray").grasps) > 0
    process.kill()


def test_nothing_was_reported_that_should_not_be(pipeline: Pipeline) -> None:
    for process in pipeline.processes:
        assert process.alive
        assert "[ERROR]" not in process.output, process.output
        assert "there is no parameter" not in process.output, process.output
