"""Parameters declared once: a frozen dataclass is the table, the descriptors and the typed snapshot in one.

A node writes

    @dataclass(frozen=True)
    class Settings(NodeParameters):
        gripper_width: float = parameter(0.08, "Largest opening of the jaw [m].", limits=(0.03, 0.16))

and ``ParameterStore(node, Settings)`` declares every field with its description and range, reads the values, and vets
every later change. A refusal says what was given and what is allowed.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from regnet_core.errors import InvalidInputError

_RULE = "rule"
_OF_ROS = ("use_sim_time", "start_type_description_service")
"""Parameters that every ROS node has."""


class ParameterError(InvalidInputError):
    """A parameter has a value that the node cannot work with."""


@dataclass(frozen=True)
class Rule:
    """What a parameter accepts."""

    description: str
    limits: tuple[float, float] | None = None
    """Least and greatest value; of each element in a list."""
    choices: Callable[[], Sequence[str]] | None = None
    """The texts that are accepted; asked for each time, because models can be added."""
    suffix: str = ""
    """Beside the choices, the path of any file with this suffix is accepted."""
    lengths: tuple[int, ...] | None = None
    """The numbers of elements that a list may have."""
    read_only: bool = False

    @property
    def constraints(self) -> str:
        """The accepted values in words, empty when everything of the right type is accepted."""
        parts = []
        if self.choices is not None:
            path = f", or the path of a {self.suffix} file" if self.suffix else ""
            parts.append("one of " + ", ".join(f"'{c}'" for c in self.choices()) + path)
        if self.lengths is not None:
            parts.append(" or ".join("an empty list" if n == 0 else f"{n} numbers" for n in self.lengths))
        if self.limits is not None:
            parts.append(f"in [{self.limits[0]:g}, {self.limits[1]:g}]")
        return ", ".join(parts)


def parameter(
    default: Any,
    description: str,
    *,
    limits: tuple[float, float] | None = None,
    choices: Callable[[], Sequence[str]] | None = None,
    suffix: str = "",
    lengths: tuple[int, ...] | None = None,
    read_only: bool = False,
) -> Any:
    """A field of a table; its ROS type follows from the default: bool, int, float, str, or a tuple of floats."""
    rule = Rule(description, limits, choices, suffix, lengths, read_only)
    return dataclasses.field(default=default, metadata={_RULE: rule})


@dataclass(frozen=True)
class NodeParameters:
    """Base of the tables: what every node has."""

    autostart: bool = parameter(
        True,
        "Whether the node configures and activates itself. False: it waits for lifecycle transitions from outside.",
        read_only=True,
    )
    stale_after: float = parameter(
        5.0, "After how long without input the diagnostics report STALE [s].", limits=(0.1, 3600.0)
    )

    @property
    def least_period(self) -> float:
        """Least time between the starts of two works [s]."""
        return 0.0

    def check(self) -> None:
        """Check what a single parameter's rule cannot: values that have to fit each other.

        Raises:
            InvalidInputError: they do not.
        """


Table = TypeVar("Table", bound=NodeParameters)

_TYPES: dict[type, tuple[Parameter.Type, str]] = {
    bool: (Parameter.Type.BOOL, "true or false"),
    int: (Parameter.Type.INTEGER, "a whole number"),
    float: (Parameter.Type.DOUBLE, "a number"),
    str: (Parameter.Type.STRING, "a text"),
    tuple: (Parameter.Type.DOUBLE_ARRAY, "a list of numbers"),
}


def rules(table: type[NodeParameters]) -> dict[str, Rule]:
    """The rule of every parameter of a table by name."""
    return {field.name: field.metadata[_RULE] for field in dataclasses.fields(table)}


def checked_value(table: type[NodeParameters], name: str, value: Any) -> Any:
    """``value`` as the type that the table's field has; whole numbers pass for numbers.

    Raises:
        ParameterError: the type is wrong, or the value is not accepted.
    """
    field = next(f for f in dataclasses.fields(table) if f.name == name)
    rule: Rule = field.metadata[_RULE]
    kind = type(field.default)
    converted = _converted(kind, value)
    if converted is None:
        allowed = ", ".join(filter(None, (_TYPES[kind][1], rule.constraints)))
        raise ParameterError(f"{name} must be {allowed}; got {_described(value)}")
    if not _accepted(rule, converted):
        raise ParameterError(f"{name} must be {rule.constraints or 'finite'}; got {_described(value)}")
    return converted


def descriptor(table: type[NodeParameters], name: str) -> ParameterDescriptor:
    """The ROS descriptor of one parameter: description, constraints in words, range, read-only flag."""
    field = next(f for f in dataclasses.fields(table) if f.name == name)
    rule: Rule = field.metadata[_RULE]
    result = ParameterDescriptor(
        name=name,
        description=rule.description,
        additional_constraints=rule.constraints,
        read_only=rule.read_only,
        type=_TYPES[type(field.default)][0].value,
    )
    if rule.limits is not None and isinstance(field.default, float):
        result.floating_point_range = [FloatingPointRange(from_value=rule.limits[0], to_value=rule.limits[1])]
    elif rule.limits is not None and isinstance(field.default, int):
        result.integer_range = [IntegerRange(from_value=int(rule.limits[0]), to_value=int(rule.limits[1]), step=1)]
    return result


class ParameterStore(Generic[Table]):
    """The parameters of one node."""

    def __init__(self, node: Node, table: type[Table], beside: Sequence[type] = ()) -> None:
        """Declare every parameter of the table on the node, with the values given by file or command line.

        Args:
            node: that has them.
            table: what they are.
            beside: tables of other nodes, whose parameters may be given as well.

        Raises:
            ParameterError: a value that was given is not accepted.
        """
        self._table = table
        self._declared = node.has_parameter
        given: dict[str, Parameter] = getattr(node, "_parameter_overrides", {})
        values: dict[str, Any] = {}
        for field in dataclasses.fields(table):
            values[field.name] = field.default
            if field.name in given and given[field.name].value is not None:
                values[field.name] = checked_value(table, field.name, given[field.name].value)
        self._current = table(**values)
        self._current.check()
        for name in rules(table):
            self._declare(node, name)
        self._warn_about_unknown(node, given, beside)

    @property
    def current(self) -> Table:
        """The values now in force; immutable, so that a callback that holds it works on one consistent set."""
        return self._current

    def vet(self, changes: Iterable[Parameter]) -> tuple[list[Parameter], Table]:
        """The changes with their values in the declared types, and the table as it would be with them.

        Raises:
            ParameterError: a value is not accepted.
            InvalidInputError: the values do not fit each other.
        """
        known, vetted, values = rules(self._table), [], {}
        for change in changes:
            if change.name not in known:
                if not self._declared(change.name):
                    raise ParameterError(f"there is no parameter '{change.name}'{_similar(change.name, known)}")
                vetted.append(change)  # one of ROS itself
                continue
            if known[change.name].read_only:
                raise ParameterError(f"{change.name} is fixed once the node runs; set it when starting the node")
            values[change.name] = checked_value(self._table, change.name, change.value)
            vetted.append(_as_parameter(change.name, values[change.name]))
        proposed = dataclasses.replace(self._current, **values)
        proposed.check()
        return vetted, proposed

    def adopt(self, proposed: Table) -> None:
        """Put a vetted table in force."""
        self._current = proposed

    def _declare(self, node: Node, name: str) -> None:
        value = _as_parameter(name, getattr(self._current, name))
        # An empty list has no type of its own in rclpy: such a parameter is declared by its type and set afterwards.
        declared = value.type_ if value.value == [] else value.value
        node.declare_parameter(name, declared, descriptor(self._table, name), ignore_override=True)
        if value.value == []:
            node.set_parameters([value])

    def _warn_about_unknown(self, node: Node, given: dict[str, Parameter], beside: Sequence[type]) -> None:
        known, others = rules(self._table), {name for table in beside for name in rules(table)}
        for name in given:
            if name in known or name in others or name in _OF_ROS or name.startswith("qos_overrides."):
                continue
            node.get_logger().warning(f"there is no parameter '{name}', its value is ignored{_similar(name, known)}")


def _similar(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def _as_parameter(name: str, value: Any) -> Parameter:
    return Parameter(name, _TYPES[type(value)][0], list(value) if isinstance(value, tuple) else value)


def _converted(kind: type, value: Any) -> Any:
    """The value as ``kind``, or None where it is of another type."""
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if kind is tuple:
        if isinstance(value, str | bytes) or not isinstance(value, Iterable):
            return None
        numbers = [_converted(float, v) for v in value]
        return None if any(n is None for n in numbers) else tuple(numbers)
    return value if type(value) is kind else None


def _accepted(rule: Rule, value: Any) -> bool:
    if rule.choices is not None and value not in rule.choices():
        return rule.suffix != "" and value.endswith(rule.suffix)
    if rule.lengths is not None and len(value) not in rule.lengths:
        return False
    numbers = value if isinstance(value, tuple) else [value] if isinstance(value, int | float) else []
    low, high = rule.limits or (-math.inf, math.inf)
    return all(math.isfinite(n) and low <= n <= high for n in numbers)


def _described(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, str):
        return f"the text '{value}'"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(list(value)) if isinstance(value, Iterable) else str(value)
