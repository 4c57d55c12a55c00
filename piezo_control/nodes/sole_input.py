# SPDX-License-Identifier: Apache-2.0
"""A topic of numbered samples that one publisher alone may send, in a way that can be heard."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_policy_name_from_kind

from piezo_gripper_msgs.msg import Sample


class SoleInput:
    """Subscribes `topic`; `on_change()` is called whenever publishers come or go.

    A publisher whose quality of service does not fit is not heard, so it disturbs nobody that is.
    """

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
        self._unfit = ""
        self._on_change = on_change
        self._subscription = node.create_subscription(
            Sample, topic, callback, qos,
            event_callbacks=SubscriptionEventCallbacks(
                matched=self._on_matched, incompatible_qos=self._on_incompatible
            ),
        )  # fmt: skip

    def close(self) -> None:
        """Let go of the topic."""
        self._node.destroy_subscription(self._subscription)

    def wrong(self) -> str:
        """Return what is wrong with the publishers: several, or one that cannot be heard; else nothing."""
        if self._count == 0 and self._unfit and self._node.count_publishers(self._topic):
            return f"'{self._topic}' is published by {self._names()} with {self._unfit}"
        return self._several(self._count)

    def others(self) -> str:
        """Return a half-sentence on who else publishes, for a sample that nobody should have sent; empty: nobody.

        Asked of the graph, which may know a publisher before its match is told.
        """
        several = self._several(self._node.count_publishers(self._topic))
        return several and f"; {several}"

    def _several(self, count: int) -> str:
        return f"'{self._topic}' has {count} publishers: {self._names()}" if count > 1 else ""

    def _names(self) -> str:
        # The name of a node that has just started may not be known yet.
        return ", ".join(
            "a node just started"
            if "UNKNOWN" in publisher.node_name
            else f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}"
            for publisher in self._node.get_publishers_info_by_topic(self._topic)
        )

    def _on_matched(self, matched: Any) -> None:
        if matched.total_count_change > max(0, matched.current_count - self._count):
            # One that is gone before a busy node looks around is in no list any more, what it sent is here.
            self._node.get_logger().warning(
                f"publishers of '{self._topic}' came and went, it has now {matched.current_count}: {self._names()}"
            )
        self._count = matched.current_count
        self._on_change()

    def _on_incompatible(self, mismatch: Any) -> None:
        policy = qos_policy_name_from_kind(mismatch.last_policy_kind)
        asked = getattr(self.qos, policy.lower(), None)
        self._unfit = f"another {policy} than {getattr(asked, 'name', asked)}, which is asked for"
        self._node.get_logger().error(
            f"a publisher of '{self._topic}' is not heard: it has {self._unfit}"
        )
        self._on_change()
