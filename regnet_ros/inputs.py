"""Subscriptions for sensor data, and the QoS profiles of everything the nodes publish."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy

RELIABILITIES = ("auto", "best_effort", "reliable")
_DEPTH = 5

OUTPUT_QOS = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
"""Results: every one arrives."""
LATCHED_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""The last result also reaches those who subscribe later."""


def reliabilities() -> Sequence[str]:
    """The values of the parameter ``input_reliability``."""
    return RELIABILITIES


class SensorInput:
    """A shallow-queue subscription that works with publishers of either reliability.

    A best-effort subscription matches every publisher, but Fast DDS with its default transports then loses every
    message that is larger than about half a megabyte, such as a full depth image's cloud. "auto" therefore asks for
    reliable delivery first and changes to best effort when a best-effort publisher shows up.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        group: CallbackGroup,
        reliability: str,
    ) -> None:
        self._node, self._kind, self._topic = node, kind, topic
        self._callback, self._group = callback, group
        self._adapts = reliability == "auto"
        first = ReliabilityPolicy.BEST_EFFORT if reliability == "best_effort" else ReliabilityPolicy.RELIABLE
        self._subscription = self._subscribe(first)

    @property
    def description(self) -> str:
        """The topic with the number of its publishers, for messages."""
        name = self._node.resolve_topic_name(self._topic)
        count = self._node.count_publishers(name)
        return f"{name} ({count} publisher{'' if count == 1 else 's'})"

    def destroy(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, reliability: ReliabilityPolicy) -> Any:
        # A reliable subscription is told of every publisher that offers less.
        watch = self._adapts and reliability == ReliabilityPolicy.RELIABLE
        return self._node.create_subscription(
            self._kind,
            self._topic,
            self._callback,
            QoSProfile(depth=_DEPTH, reliability=reliability),
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible) if watch else None,
        )

    def _on_incompatible(self, event: Any) -> None:
        if event.last_policy_kind != QoSPolicyKind.RELIABILITY or not self._adapts:
            return
        self._adapts = False
        self._node.get_logger().info(f"a publisher of {self.description} is best effort: receiving best effort, too")
        self._node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe(ReliabilityPolicy.BEST_EFFORT)
