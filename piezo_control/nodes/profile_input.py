# SPDX-License-Identifier: Apache-2.0
"""A signal that a node takes as single values or as a profile that travels ahead: the newest counts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rclpy.node import Node

from piezo_control.nodes.qos import LATCHED, SETPOINT
from piezo_control.profile import Profile, SampledProfile
from piezo_gripper_msgs.msg import Profile as ProfileMessage
from piezo_gripper_msgs.msg import Sample


def to_message(profile: Profile) -> ProfileMessage:
    """Return the message that says `profile`."""
    return ProfileMessage(
        time=profile.time.tolist(),
        value=profile.value.tolist(),
        interpolation=ProfileMessage.LINEAR if profile.linear else ProfileMessage.HOLD,
    )


class ProfileInput:
    """Subscribes TOPIC (Sample) and TOPIC_profile (Profile); ``input[k]`` is the value at sample k.

    `on_change()` is called with every new one.
    """

    def __init__(
        self,
        node: Node,
        topic: str,
        sample_time: float,
        largest: float,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        self._on_change = on_change
        self._node = node
        self._topic = topic
        self._largest = largest
        self._sampled = SampledProfile(Profile([0.0], [0.0]), sample_time)
        node.create_subscription(Sample, topic, self._on_value, SETPOINT)
        node.create_subscription(ProfileMessage, f"{topic}_profile", self._on_profile, LATCHED)

    def __getitem__(self, number: int) -> float:
        return self._sampled[number]

    @property
    def profile(self) -> Profile:
        """The signal over time."""
        return self._sampled.profile

    def restart(self, sample_time: float) -> None:
        """Read the same signal at another sample time."""
        self._sampled = SampledProfile(self._sampled.profile, sample_time)

    def _on_value(self, sample: Sample) -> None:
        self._take(self._topic, [0.0], [sample.value], linear=False)

    def _on_profile(self, message: ProfileMessage) -> None:
        linear = message.interpolation == ProfileMessage.LINEAR
        self._take(f"{self._topic}_profile", message.time, message.value, linear)

    def _take(self, topic: str, time: list[float], value: list[float], linear: bool) -> None:
        try:
            profile = Profile(time, value, linear)
            if not np.all(np.abs(profile.value) <= self._largest):
                raise ValueError(
                    f"value is up to {np.max(np.abs(profile.value)):g}, must be within "
                    f"±{self._largest:g}; the unit is that of the topic, m or N"
                )
        except ValueError as error:
            self._node.get_logger().error(f"'{topic}' ignored: {error}")
            return
        self._sampled = SampledProfile(profile, self._sampled.sample_time)
        self._on_change()
