# SPDX-License-Identifier: Apache-2.0
"""A signal that a node takes as single values, a profile that travels ahead or a waveform: the newest counts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from std_msgs.msg import Header

from piezo_control.nodes.qos import FOLLOWED, LATCHED, SETPOINT
from piezo_control.profile import Profile, SampledSignal, Signal
from piezo_control.safety import LARGEST_FORCE
from piezo_control.waveform import SHAPES, Waveform
from piezo_gripper_msgs.msg import Profile as ProfileMessage
from piezo_gripper_msgs.msg import Sample
from piezo_gripper_msgs.msg import Waveform as WaveformMessage

if TYPE_CHECKING:
    from piezo_control.nodes.base import FingerNode


def to_message(profile: Profile, max_force: float = 0.0) -> ProfileMessage:
    """Return the message that says `profile`, on the way of which a finger pushes with `max_force` (N) at most."""
    return ProfileMessage(
        max_force=max_force,
        time=profile.time.tolist(),
        value=profile.value.tolist(),
        interpolation=ProfileMessage.LINEAR if profile.linear else ProfileMessage.HOLD,
    )


def from_message(message: ProfileMessage) -> Profile:
    """Return the profile that a message says; ValueError for one that says none."""
    return Profile(message.time, message.value, message.interpolation == ProfileMessage.LINEAR)


def waveform_message(waveform: Waveform) -> WaveformMessage:
    """Return the message that says `waveform`."""
    numbers = {name: float(value) for name, value in vars(waveform).items() if name != "shape"}
    return WaveformMessage(shape=SHAPES.index(waveform.shape), **numbers)


class ProfileInput:
    """Subscribes TOPIC (Sample), TOPIC_profile and TOPIC_waveform; ``input[k]`` is the value at sample k.

    A profile is kept for who joins later; a waveform moves the fingers that are there when it is sent.
    `on_change()` is called after every new signal. Where it `says` so, TOPIC_followed_profile and
    TOPIC_followed_waveform are what is followed.
    """

    def __init__(
        self,
        node: FingerNode,
        topic: str,
        sample_time: float,
        largest: float,
        on_change: Callable[[], None] = lambda: None,
        says: bool = False,
    ) -> None:
        self._on_change = on_change
        self._node = node
        self._topic = topic
        self._largest = largest
        self.max_force = 0.0
        """Force (N) that the sender allows, as messages have it: 0 where it says nothing."""
        self._sampled = SampledSignal(Profile([0.0], [0.0]), sample_time)
        self._is_new = True
        self.is_known = False
        """Whether anybody has sent one."""
        if says:
            self._profiles = node.create_publisher(
                ProfileMessage, f"{topic}_followed_profile", FOLLOWED
            )
            self._waveforms = node.create_publisher(
                WaveformMessage, f"{topic}_followed_waveform", FOLLOWED
            )
        node.create_subscription(Sample, topic, self._on_value, SETPOINT)
        node.create_subscription(ProfileMessage, f"{topic}_profile", self._on_profile, LATCHED)
        node.create_subscription(WaveformMessage, f"{topic}_waveform", self._on_waveform, SETPOINT)

    def __getitem__(self, number: int) -> float:
        return self._sampled[number]

    @property
    def signal(self) -> Signal:
        """The signal over time."""
        return self._sampled.signal

    def restart(self, sample_time: float) -> None:
        """Read the same signal in another run, at its sample time."""
        self._sampled = SampledSignal(self._sampled.signal, sample_time)
        self._is_new = True

    def hold(self, value: float, max_force: float) -> None:
        """Stay at `value` with `max_force` (N; 0: none) where nobody has sent anything; NaN: as it is."""
        held = (self[0], self.max_force)
        if not (self.is_known or math.isnan(value) or (value, max_force) == held):
            self._sampled = SampledSignal(Profile([0.0], [value]), self._sampled.sample_time)
            self.max_force = max_force
            self._is_new = True
            self._on_change()

    def say(self, header: Header) -> None:
        """Publish what is followed from the sample with this header on, if it is new or the run is."""
        if not self._is_new:
            return
        self._is_new = False
        signal = self.signal
        if isinstance(signal, Waveform):
            waveform = waveform_message(signal)
            waveform.header = header
            self._waveforms.publish(waveform)
        elif isinstance(signal, Profile):
            profile = to_message(signal, self.max_force)
            profile.header = header
            self._profiles.publish(profile)

    def _on_value(self, sample: Sample) -> None:
        self._take(self._topic, lambda: Profile([0.0], [sample.value]))

    def _on_profile(self, message: ProfileMessage) -> None:
        self._take(f"{self._topic}_profile", lambda: from_message(message), message.max_force)

    def _on_waveform(self, message: WaveformMessage) -> None:
        def make() -> Waveform:
            waveform = Waveform.of(message)
            rate = 1.0 / self._sampled.sample_time
            if waveform.highest_frequency > 0.5 * rate:
                raise ValueError(
                    f"frequency is up to {waveform.highest_frequency:g} Hz, must be at most half the loop's "
                    f"{rate:g} Hz"
                )
            return waveform

        self._take(f"{self._topic}_waveform", make)

    def _take(self, topic: str, make: Callable[[], Signal], max_force: float = 0.0) -> None:
        try:
            signal = make()
            if not signal.largest <= self._largest:
                raise ValueError(
                    f"value is up to {signal.largest:g}, must be within ±{self._largest:g}; the unit is that "
                    "of the topic, m or N"
                )
            if not 0.0 <= max_force <= LARGEST_FORCE:
                raise ValueError(f"max_force is {max_force:g}, must be in [0, {LARGEST_FORCE:g}] N")
        except ValueError as error:
            self._node.refuse(f"'{topic}' ignored: {error}")
            return
        self._sampled = SampledSignal(signal, self._sampled.sample_time)
        self.max_force = max_force
        self._is_new = self.is_known = True
        self._on_change()
