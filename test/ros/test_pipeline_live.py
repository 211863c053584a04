"""The three nodes together: bags replayed by the player, compared with the golden files of tools/make_golden.py.

The golden files come from the library alone, so that this also shows that nothing is lost or changed on the way through
messages. Every model with a folder of golden files is compared, all with the same nodes; golden.py has the tolerances.
"""

from __future__ import annotations

import pytest
from golden import FILES
from live import System, wait_for
from pipelines import MODELS, NODES, Pipeline


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
    pipeline.check(model, bag)


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
