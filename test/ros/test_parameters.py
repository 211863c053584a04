"""The tables of parameters: every default is valid, refusals name the range, the configuration files fit the tables."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest
import yaml
from live import REPOSITORY
from rclpy.parameter import Parameter

from regnet_core.errors import InvalidInputError
from regnet_core.gripper import Gripper
from regnet_ros.parameters import NodeParameters, ParameterError, checked_value, descriptor, parameter, rules
from regnet_ros.settings import DetectorParameters, PreprocessorParameters, SelectorParameters

TABLES: dict[str, type[NodeParameters]] = {
    "preprocessor": PreprocessorParameters,
    "detector": DetectorParameters,
    "selector": SelectorParameters,
}
EVERY = [(table, name) for table in TABLES.values() for name in rules(table)]


@pytest.mark.parametrize(("table", "name"), EVERY, ids=lambda value: getattr(value, "__name__", value))
def test_every_default_is_accepted_and_described(table: type[NodeParameters], name: str) -> None:
    default = getattr(table(), name)
    assert checked_value(table, name, default) == default
    assert descriptor(table, name).description.endswith(".")


@pytest.mark.parametrize(("table", "name"), EVERY, ids=lambda value: getattr(value, "__name__", value))
def test_every_wrong_type_is_refused_with_the_right_one(table: type[NodeParameters], name: str) -> None:
    wrong: Any = 3.5 if isinstance(getattr(table(), name), str) else "wide"
    with pytest.raises(ParameterError, match=rf"{name} must be (a|true).*; got"):
        checked_value(table, name, wrong)


@pytest.mark.parametrize("table", TABLES.values())
def test_defaults_fit_each_other(table: type[NodeParameters]) -> None:
    assert table().check() is None


@pytest.mark.parametrize("value", [0.029, 0.161, 0.5, 0, -1, math.nan, math.inf])
def test_a_width_outside_of_the_range_is_refused_with_the_range(value: float) -> None:
    with pytest.raises(ParameterError, match=r"gripper_width must be in \[0\.03, 0\.16\]; got"):
        checked_value(DetectorParameters, "gripper_width", value)


@pytest.mark.parametrize("value", [True, "0.08", [0.08], None, b"x"])
def test_a_width_that_is_no_number_is_refused(value: Any) -> None:
    with pytest.raises(ParameterError, match=r"gripper_width must be a number, in \[0\.03, 0\.16\]; got"):
        checked_value(DetectorParameters, "gripper_width", value)


def test_whole_numbers_pass_for_numbers() -> None:
    assert checked_value(SelectorParameters, "reach_max", 1) == 1.0
    assert type(checked_value(SelectorParameters, "reach_max", 1)) is float
    assert checked_value(PreprocessorParameters, "crop_min", [0, 0, 1]) == (0.0, 0.0, 1.0)
    with pytest.raises(ParameterError, match="max_points must be a whole number"):
        checked_value(PreprocessorParameters, "max_points", 10.0)


def test_lists_of_the_wrong_length_or_content_are_refused() -> None:
    with pytest.raises(ParameterError, match="an empty list or 6 numbers"):
        checked_value(PreprocessorParameters, "sensor_pose", [0.0, 0.0, 1.0])
    with pytest.raises(ParameterError, match=r"in \[-1000, 1000\]"):
        checked_value(PreprocessorParameters, "crop_min", [0.0, 0.0, math.nan])
    with pytest.raises(ParameterError, match="a list of numbers"):
        checked_value(PreprocessorParameters, "crop_min", ["a", "b", "c"])


def test_unknown_choices_are_refused_with_the_choices() -> None:
    with pytest.raises(ParameterError, match="one of 'heuristic', 'analytic'; got the text 'best'"):
        checked_value(SelectorParameters, "policy", "best")
    for model in ("resnet", "weights/regnetv2-s.pth", ""):
        with pytest.raises(
            ParameterError, match=r"'antipodal', 'random', or the path of a \.safetensors file; got the"
        ):
            checked_value(DetectorParameters, "model", model)


def test_a_model_may_be_the_path_of_a_file() -> None:
    for model in ("/home/me/run 7/weights.safetensors", "weights.safetensors", "antipodal"):
        assert checked_value(DetectorParameters, "model", model) == model


@pytest.mark.parametrize(
    ("table", "values", "message"),
    [
        (
            PreprocessorParameters,
            {"crop_min": (0.0, 0.0, 1.0), "crop_max": (1.0, 1.0, 1.0)},
            "crop_min must be less .* z",
        ),
        (PreprocessorParameters, {"target_frame": " "}, "target_frame must be the name"),
        (
            DetectorParameters,
            {"workspace_min": (2.0, 0.0, 0.0), "workspace_max": (1.0, 1.0, 1.0)},
            "workspace_min .* x",
        ),
        (DetectorParameters, {"approach_axis": (0.0, 0.0, 0.0)}, "approach_axis must be a direction"),
        (SelectorParameters, {"reach_min": 1.0, "reach_max": 1.0}, "reach_min must be less than reach_max"),
    ],
)
def test_values_that_do_not_fit_each_other_are_refused(
    table: type[NodeParameters], values: dict[str, Any], message: str
) -> None:
    with pytest.raises(InvalidInputError, match=message):
        table(**values).check()


def test_the_gripper_of_the_parameters() -> None:
    table = DetectorParameters(gripper_width=0.05, gripper_palm_depth=0.1)
    assert table.gripper == Gripper(width=0.05, palm_depth=0.1)
    for name, limits in Gripper.LIMITS.items():
        assert rules(DetectorParameters)[f"gripper_{name}"].limits == limits


def test_limits_at_the_far_end_limit_nothing() -> None:
    assert PreprocessorParameters().config.workspace is None
    assert DetectorParameters().filters.workspace is None
    assert DetectorParameters().filters.target is None
    assert SelectorParameters().limits.reach_max == math.inf
    assert DetectorParameters(workspace_min=(0.0, -1000.0, -1000.0)).filters.workspace is not None


def test_what_changes_a_detection() -> None:
    table = DetectorParameters()
    assert not table.same_result(dataclasses.replace(table, gripper_width=0.05))
    assert not table.same_result(dataclasses.replace(table, min_quality=0.5))
    assert table.same_result(dataclasses.replace(table, redetect_on_change=True, stale_after=1.0))


def test_descriptors_carry_ranges_for_tools() -> None:
    width = descriptor(DetectorParameters, "gripper_width")
    assert (width.floating_point_range[0].from_value, width.floating_point_range[0].to_value) == (0.03, 0.16)
    assert width.type == Parameter.Type.DOUBLE.value
    points = descriptor(PreprocessorParameters, "max_points")
    assert points.integer_range[0].to_value == 10_000_000
    assert descriptor(SelectorParameters, "policy").additional_constraints == "one of 'heuristic', 'analytic'"
    assert descriptor(DetectorParameters, "autostart").read_only


def test_a_table_of_ones_own() -> None:
    @dataclasses.dataclass(frozen=True)
    class Own(NodeParameters):
        speed: float = parameter(1.0, "Speed [m/s].", limits=(0.0, 2.0))

    assert checked_value(Own, "speed", 2) == 2.0
    with pytest.raises(ParameterError, match=r"speed must be in \[0, 2\]; got 2\.1"):
        checked_value(Own, "speed", 2.1)


def test_the_configuration_file_fits_the_tables() -> None:
    sections = yaml.safe_load((REPOSITORY / "config" / "regnet.yaml").read_text())
    assert {name.rpartition("/")[2] for name in sections} == set(TABLES)
    for name, section in sections.items():
        table = TABLES[name.rpartition("/")[2]]
        values = {key: checked_value(table, key, value) for key, value in section["ros__parameters"].items()}
        assert table(**values).check() is None
