# SPDX-License-Identifier: Apache-2.0
"""A finger's temperature, as thermocouples publish it; values that none reads are named and passed over."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node
from sensor_msgs.msg import Temperature

from piezo_control.nodes.block import seconds
from piezo_control.nodes.qos import SAMPLE
from piezo_control.safety import HIGHEST_DEGC, LOWEST_DEGC


class TemperatureInput:
    """Subscribes `temperature` and calls `on_temperature` with its value (°C) and time stamp (s)."""

    def __init__(self, node: Node, on_temperature: Callable[[float, float], None]) -> None:
        self._node = node
        self._on_temperature = on_temperature
        self._subscription = node.create_subscription(
            Temperature, "temperature", self._take, SAMPLE
        )

    def close(self) -> None:
        """Let go of the topic."""
        self._node.destroy_subscription(self._subscription)

    def _take(self, message: Temperature) -> None:
        degc = message.temperature
        if LOWEST_DEGC <= degc <= HIGHEST_DEGC:
            self._on_temperature(degc, seconds(message.header.stamp))
        else:
            self._node.get_logger().error(
                f"'temperature' is {degc} °C, must be within [{LOWEST_DEGC:g}, {HIGHEST_DEGC:g}] °C; ignored",
                throttle_duration_sec=1.0,
            )
