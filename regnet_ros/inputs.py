"""Subscriptions for sensor data, and the QoS profiles of everything the nodes publish."""

from __future__ import annotations

import threading
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

NEXT_CLOUD = "next_cloud"
"""Topic on which a detector says in how long it will have time for another cloud."""


def reliabilities() -> Sequence[str]:
    """The values of the parameter ``input_reliability``."""
    return RELIABILITIES


_RELIABLE, _BEST_EFFORT = ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT

_LARGE = (
    ", best effort: Fast DDS loses large clouds on it, unless the publisher is made reliable or started as "
    "config/fastdds_large_clouds.xml says"
)


class SensorInput:
    """A shallow-queue subscription that works with publishers of either reliability.

    A best-effort subscription matches every publisher, but Fast DDS with its default transports then loses every
    message that is larger than about half a megabyte, such as a full depth image's cloud. "auto" therefore asks for
    reliable delivery, and changes to best effort for as long as there is a best-effort publisher.
    """

    def __init__(
        self,
        node: Node,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        group: CallbackGroup,
        reliability: str,
        serialized: bool = False,
    ) -> None:
        self._serialized = serialized
        self._node, self._kind, self._topic = node, kind, topic
        self._callback, self._group = callback, group
        self._adapts = reliability == "auto"
        self._lock = threading.Lock()
        self._subscription = self._subscribe(_BEST_EFFORT if reliability == "best_effort" else _RELIABLE)

    @property
    def description(self) -> str:
        """The topic with the number of its publishers, for messages."""
        name = self._node.resolve_topic_name(self._topic)
        count = self._node.count_publishers(name)
        hint = _LARGE if count > 0 and self._reliability == _BEST_EFFORT else ""
        return f"{name} ({count} publisher{'' if count == 1 else 's'}{hint})"

    def refresh(self) -> None:
        """Ask for reliable delivery again once the last best-effort publisher has gone; call it now and then."""
        if not self._adapts or self._reliability != _BEST_EFFORT:
            return
        offers = self._node.get_publishers_info_by_topic(self._node.resolve_topic_name(self._topic))
        if all(offer.qos_profile.reliability == _RELIABLE for offer in offers):
            self._change_to(_RELIABLE)

    def destroy(self) -> None:
        """End the subscription."""
        with self._lock:
            self._adapts = False
            self._node.destroy_subscription(self._subscription)

    @property
    def _reliability(self) -> ReliabilityPolicy:
        return self._subscription.qos_profile.reliability

    def _subscribe(self, reliability: ReliabilityPolicy) -> Any:
        # A reliable subscription is told of every publisher that offers less.
        watch = self._adapts and reliability == _RELIABLE
        return self._node.create_subscription(
            self._kind,
            self._topic,
            self._callback,
            QoSProfile(depth=_DEPTH, reliability=reliability),
            callback_group=self._group,
            raw=self._serialized,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible) if watch else None,
        )

    def _on_incompatible(self, event: Any) -> None:
        if event.last_policy_kind == QoSPolicyKind.RELIABILITY:
            self._change_to(_BEST_EFFORT)

    def _change_to(self, reliability: ReliabilityPolicy) -> None:
        with self._lock:
            if not self._adapts or self._reliability == reliability:
                return
            self._node.destroy_subscription(self._subscription)
            self._subscription = self._subscribe(reliability)
        words = (
            "best effort, as a publisher is" if reliability == _BEST_EFFORT else "reliably, as all publishers offer it"
        )
        self._node.get_logger().info(f"receiving {self._node.resolve_topic_name(self._topic)} {words}")
