# SPDX-License-Identifier: Apache-2.0
"""A topic of numbered samples that one publisher alone may send."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile

from piezo_gripper_msgs.msg import Sample


class SoleInput:
    """Subscribes `topic`; `on_change()` is called whenever publishers come or go."""

    def __init__(
        self,
        node: Node,
        topic: str,
        callback: Callable[[Sample], None],
        qos: QoSProfile,
        on_change: Callable[[], None],
    ) -> None:
        self.qos = qos
        self._node = node
        self._topic = node.resolve_topic_name(topic)
        self._count = 0
        self._on_change = on_change
        self._subscription = node.create_subscription(
            Sample, topic, callback, qos,
            event_callbacks=SubscriptionEventCallbacks(matched=self._on_matched),
        )  # fmt: skip

    def close(self) -> None:
        """Let go of the topic."""
        self._node.destroy_subscription(self._subscription)

    def doubles(self) -> str:
        """Return what is wrong when there are several publishers, naming their nodes; else nothing."""
        if self._count <= 1:
            return ""
        # The name of a node that has just started may not be known yet.
        names = ", ".join(
            "a node just started"
            if "UNKNOWN" in publisher.node_name
            else f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            for publisher in self._node.get_publishers_info_by_topic(self._topic)
        )
        return f"'{self._topic}' has {self._count} publishers: {names}"

    def _on_matched(self, matched: Any) -> None:
        self._count = matched.current_count
        self._on_change()
