"""The detector's models: networks by path, switching while clouds come, refusals."""

from __future__ import annotations

import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from clouds import ODD_CLOUDS, SCENE, cloud
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from live import NodeProcess, System, values_of
from regnet_msgs.msg import GraspArray
from sensor_msgs.msg import PointCloud2

from regnet_core import GraspDetector, Gripper, weights
from regnet_ros.conversions import grasps_from_messages


class Switchable:
    """A detector that starts with antipodal, and does not know torch yet."""

    def __init__(self, system: System, network: Path) -> None:
        self.system, self.peer, self.network = system, system.peer, str(network)
        self.process: NodeProcess = system.start_node(
            "detector", model="antipodal", max_grasps=40, target_frame="world"
        )
        self.grasps = self.peer.listen(GraspArray, "grasps")
        self._stamp = 100

    def answer(self, message: PointCloud2 | None = None) -> GraspArray:
        """What comes back for one cloud."""
        message = cloud(SCENE) if message is None else message
        self._stamp += 1
        message.header.stamp.sec = self._stamp
        self.peer.publisher(PointCloud2, "cloud").publish(message)
        return self.grasps.wait(lambda array: array.header == message.header, what="GraspArray")

    def change(self, **values: Any) -> None:
        result = self.peer.set_parameters("detector", values)
        assert result.successful, result.reason

    def shown(self) -> tuple[str, str]:
        """Model and device in the diagnostics."""
        self.peer.diagnostics.clear()
        values = values_of(self.peer.wait_for_status("detector"))
        return values["model"], values["device"]


@pytest.fixture(scope="module")
def switchable(system: System, tmp_path_factory: pytest.TempPathFactory) -> Switchable:
    """With a network of one's own: the published weights under another name."""
    published = Path(weights.__file__).parent / "regnetv2-s.safetensors"
    return Switchable(system, Path(shutil.copy(published, tmp_path_factory.mktemp("weights") / "own.safetensors")))


def test_the_model_and_its_device_are_told_before_the_node_is_active(switchable: Switchable) -> None:
    output = switchable.process.output
    assert 0 < output.index("warm-up of antipodal took") < output.index("model antipodal on cpu")
    assert output.index("model antipodal on cpu") < output.index("active, waiting")
    assert switchable.shown() == ("antipodal", "cpu")
    answer = switchable.answer()
    assert (answer.model, answer.device) == ("antipodal", "cpu")


def test_while_a_network_is_loaded_every_cloud_is_answered_by_the_old_model(switchable: Switchable) -> None:
    before, values = [], {"model": switchable.network, "device": "cpu"}
    with ThreadPoolExecutor(1) as pool:
        change = pool.submit(switchable.peer.set_parameters, "detector", values)
        while not change.done():
            before.append(switchable.answer())
    assert change.result().successful, change.result().reason
    assert len(before) >= 3  # loading torch takes longer than so many detections
    assert {answer.model for answer in before[:-1]} == {"antipodal"}
    assert all(len(answer.grasps) > 0 for answer in before[:-1])
    answer = switchable.answer()
    assert (answer.model, answer.device) == (switchable.network, "cpu")
    assert switchable.shown() == (switchable.network, "cpu")
    output = switchable.process.output
    assert output.index(f"warm-up of {switchable.network} took") < output.index(f"model {switchable.network} on cpu")
    counts = values_of(switchable.peer.wait_for_status("detector"))
    assert counts["dropped for a newer one"] == "0"
    assert int(counts["received"]) == int(counts["processed"])


def test_the_node_gives_what_the_library_finds_with_the_network(switchable: Switchable) -> None:
    received = grasps_from_messages(switchable.answer().grasps)
    points = SCENE.astype("float32")
    expected = GraspDetector(switchable.network, "cpu").detect(points, Gripper()).grasps[: len(received)]
    assert len(received) > 0
    # The number of threads decides in which order sums are made.
    assert abs(received.quality.mean() - expected.quality.mean()) < 0.01
    assert abs(received.translation.mean(axis=0) - expected.translation.mean(axis=0)).max() < 0.01


def test_a_model_that_was_in_use_before_is_not_warmed_up_again(switchable: Switchable) -> None:
    switchable.change(model="antipodal")
    assert switchable.answer().model == "antipodal"
    switchable.change(model=switchable.network)
    assert switchable.answer().model == switchable.network
    assert switchable.process.output.count("warm-up of") == 2


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"model": "nonsense"}, r"model must be one of .*'antipodal', 'random', or the path of a \.safetensors file; "),
        ({"model": "/nowhere/net.safetensors"}, r"there are no weights at '/nowhere/net\.safetensors'"),
        ({"model": "DAMAGED"}, r"DAMAGED' holds no weights of a network"),
        ({"device": "cuda:99"}, r"does not run on 'cuda:99' here.*; there are auto, cpu"),
        ({"model": "antipodal", "device": "cuda"}, r"'antipodal' runs on the device 'cpu'"),
        ({"threads": 1}, r"threads is fixed once the node runs"),
    ],
)
def test_what_cannot_be_loaded_is_refused_and_the_old_model_stays(
    switchable: Switchable, tmp_path: Path, values: dict[str, Any], message: str
) -> None:
    damaged = tmp_path / "net.safetensors"
    damaged.write_bytes(Path(switchable.network).read_bytes()[:1000])
    values = {name: str(damaged) if value == "DAMAGED" else value for name, value in values.items()}
    result = switchable.peer.set_parameters("detector", values)
    assert not result.successful
    assert re.search(message.replace("DAMAGED", re.escape(str(damaged))), result.reason), result.reason
    assert switchable.peer.get_parameter("detector", "model") == switchable.network
    assert switchable.peer.get_parameter("detector", "device") == "cpu"
    assert switchable.answer().model == switchable.network
    assert switchable.shown() == (switchable.network, "cpu")


@pytest.mark.parametrize("odd", ODD_CLOUDS, ids=lambda odd: odd.name)
def test_a_network_answers_every_odd_cloud(switchable: Switchable, odd: Any) -> None:
    answer = switchable.answer(odd.make())
    assert (answer.model, answer.device) == (switchable.network, "cpu")
    if odd.decoder:
        assert len(answer.grasps) == 0
    if len(answer.grasps) == 0:  # an untrained network finds some in anything that has a surface, and few in a box
        assert re.search(odd.detector or "rejected", answer.reason), answer.reason
    assert switchable.process.alive


def test_another_model_is_applied_to_the_last_cloud_when_that_is_wanted(switchable: Switchable) -> None:
    last = switchable.answer()
    switchable.change(redetect_on_change=True)
    switchable.change(model="antipodal")
    again = switchable.grasps.wait(lambda array: array.model == "antipodal" and array.header == last.header)
    assert len(again.grasps) > 0
    switchable.change(redetect_on_change=False)


def test_weights_that_are_not_there_keep_the_node_unconfigured_until_others_are_set(switchable: Switchable) -> None:
    peer = switchable.peer
    other = switchable.system.start(
        "detector", "--ros-args", "-r", "__node:=other", "-p", "model:=missing.safetensors", "-p", "threads:=1"
    )
    status = peer.wait_for_status("other", lambda s: s.level == DiagnosticStatus.ERROR)
    assert re.search(r"cannot configure: there are no weights at '/.*missing\.safetensors'", status.message)
    assert peer.state("other") == "unconfigured"
    assert peer.set_parameter("other", "model", switchable.network).successful
    assert peer.change_state("other", Transition.TRANSITION_CONFIGURE)
    assert peer.change_state("other", Transition.TRANSITION_ACTIVATE)
    assert f"model {switchable.network} on " in other.output
    other.signal(2)
    assert other.wait() == 0
    assert "Traceback" not in other.output


def test_a_node_with_a_network_ends_cleanly(switchable: Switchable) -> None:
    switchable.process.signal(2)
    assert switchable.process.wait(10.0) == 0
    assert "Traceback" not in switchable.process.output
