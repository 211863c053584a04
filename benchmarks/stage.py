"""What a stage is: a name for the work of some functions of regnet_core or regnet_ros."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from regnet_core.nn.config import NetworkConfig

Group = Literal["messages", "preparation", "search", "network", "decisions"]
GROUPS: dict[Group, str] = {
    "messages": "between ROS messages and arrays",
    "preparation": "of the cloud, before the proposals",
    "search": "for neighbours, inside the network",
    "network": "layers and what holds them together",
    "decisions": "which grasps stay, and in which order",
}
"""What the groups hold."""

Needed = Callable[[NetworkConfig | None], bool]
"""Whether a stage must run, given the network's configuration or, for other models, None."""


def always(_: NetworkConfig | None) -> bool:
    return True


def maybe(_: NetworkConfig | None) -> bool:
    return False


def network(config: NetworkConfig | None) -> bool:
    return config is not None


def other_model(config: NetworkConfig | None) -> bool:
    return config is None


def with_regions(config: NetworkConfig | None) -> bool:
    return config is not None and config.region is not None


def with_refinement(config: NetworkConfig | None) -> bool:
    return config is not None and config.refinement is not None


def with_shapes(config: NetworkConfig | None) -> bool:
    return config is not None and config.shape_radius > 0.0


@dataclass(frozen=True)
class Stage:
    """One stage: everything that its functions do, but for the stages inside."""

    name: str
    group: Group
    what: str
    """For people: what the time goes into."""
    targets: tuple[str, ...]
    """``module:function`` or ``module:Class.method``, where they are defined."""
    needed: Needed = always
    numbered: Literal["", "up", "down"] = ""
    """Whether each call is a stage of its own, counted from 1, or down to 1, which all further ones belong to."""
    ledger: str = ""
    """The stage of regnet_core/nn/ledger.py whose operations these are."""

    def numbered_name(self, number: int) -> str:
        """The name of the stage that one call is."""
        return f"{self.name} {number}"

    def names(self, levels: int) -> list[str]:
        """The names under which its times are found, for a network with so many levels."""
        if not self.numbered:
            return [self.name]
        numbers = range(1, levels + 1) if self.numbered == "up" else range(levels, 0, -1)
        return [self.numbered_name(number) for number in numbers]
