# SPDX-License-Identifier: Apache-2.0
"""The disturbance of the paper: the temperature of the finger, a profile over time.

in:  clock (rosgraph_msgs/Clock): in lock-step, the instant up to which temperatures are used up
out: temperature (sensor_msgs/Temperature, °C)

In lock-step the temperatures travel ahead of their use on a grid of instants, stamped with the instant
from which each holds, so that a run does not depend on the machine's speed; the same clock again is a
request to repeat. Running free, the profile follows the wall clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Temperature

from piezo_control.nodes import base as finger_node
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.qos import SAMPLE
from piezo_control.parameters import ParameterError
from piezo_sim.nodes.parameters import TemperatureNodeParameters
from piezo_sim.temperature import temperature


class TemperatureNode(FingerNode):
    NAME = "temperature"
    PARAMETERS = TemperatureNodeParameters

    def __init__(self) -> None:
        super().__init__()
        self.temperatures = self.create_publisher(Temperature, "temperature", SAMPLE)
        self.create_subscription(Clock, "clock", self._on_clock, SAMPLE)
        self.tick = self.create_steady_timer(1.0, self._tick, autostart=False)
        self.next = 0

    def start(self) -> None:
        temperature(self.parameters, 0, 1)  # a file that cannot be replayed refuses the activation
        self.next = 0
        self.last_clock = -1.0
        if self.parameters.mode == "free_running":
            self.tick.timer_period_ns = round(self.parameters.period * 1e9)
            self.tick.reset()
            self.say(f"publishes '{self.temperatures.topic_name}'")
        else:
            self.say(f"waits for '{self.resolve_topic_name('clock')}'")

    def stop(self) -> None:
        self.tick.cancel()

    def _on_clock(self, message: Clock) -> None:
        p = self.parameters
        if not self.active or p.mode != "lockstep":
            return
        if self.next == 0 and self.temperatures.get_subscription_count() < p.subscribers:
            return  # the cantilever asks again
        now = message.clock.sec + message.clock.nanosec * 1e-9
        if now < 0.0:
            self.get_logger().error(
                f"'clock' is {now:g} s, must be at least 0 s; ignored", throttle_duration_sec=1.0
            )
            return
        place = math.floor(now / p.period + 1e-9)
        # Nobody waits for what lies before a clock that leaps ahead; to send it all may never end.
        if now <= self.last_clock or place > self.next:
            self.next = place
        self.last_clock = now
        end = math.floor((now + p.ahead) / p.period + 1e-9) + 1
        self._publish(end)
        self.say(f"publishes '{self.temperatures.topic_name}'")

    def _publish(self, end: int) -> None:
        """Publish the grid's temperatures from `self.next` up to, not including, `end`."""
        p = self.parameters
        for index, value in enumerate(self._ahead(end - self.next), self.next):
            message = Temperature(temperature=float(value))
            stamp = message.header.stamp
            stamp.sec, stamp.nanosec = divmod(round(index * p.period * 1e9), 10**9)
            self.temperatures.publish(message)
        self.next = max(end, self.next)

    def _ahead(self, count: int) -> Iterable[float]:
        """Return the next temperatures; none, and deactivate, where a replayed file became unusable."""
        try:
            return temperature(self.parameters, self.next, count)
        except ParameterError as error:
            self.get_logger().error(f"deactivates: {error}")
            self.trigger_deactivate()
            return ()

    def _tick(self) -> None:
        for value in self._ahead(1):
            message = Temperature(temperature=float(value))
            message.header.stamp = self.get_clock().now().to_msg()
            self.temperatures.publish(message)
            self.next += 1


def main() -> int:
    return finger_node.run(TemperatureNode)
