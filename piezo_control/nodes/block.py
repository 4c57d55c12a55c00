# SPDX-License-Identifier: Apache-2.0
"""A block of the loop: one numbered sample in, one out, each answered exactly once.

In lock-step, that makes the loop deterministic whatever the transport does (:mod:`piezo_control.sequence`):
a stray sample means that somebody else answered samples of this topic, which no order of computation can
mend. Running free, only the newest sample counts, and one that is too old is not acted upon.

What cannot be right latches a fault (:mod:`piezo_control.safety`): a second publisher of the input or one that
cannot be heard, samples at another sample time than this block's, samples of the other mode. The block then
answers no more until `~/reset` or the next activation. It tells the finger on `fault`, so that it goes to rest
and its `state` says why.
"""

from __future__ import annotations

import math
import time
from typing import Any

from rclpy.qos import QoSProfile

from piezo_control.feedback import FeedbackParameters
from piezo_control.nodes import base
from piezo_control.nodes.base import FingerNode
from piezo_control.nodes.qos import FAULTS, LATCHED, NEWEST, SAMPLE
from piezo_control.nodes.sample_output import SampleOutput
from piezo_control.nodes.sole_input import SoleInput
from piezo_control.safety import (
    LARGEST_DEFLECTION,
    LARGEST_FORCE,
    LARGEST_VOLTAGE,
    Guard,
    is_physical,
)
from piezo_control.sequence import FIRST, REPEATED, STRAY, Sequence
from piezo_gripper_msgs.msg import Fault, FingerState, Sample

SIMULATED_TIME = 1e8  # s: a stamp below is no time of a clock on a wall


def command_range(controller: FeedbackParameters) -> dict[str, float]:
    """Return the ends of a controller's command, as figures for `/diagnostics`."""
    return {f"{name} [m]": getattr(controller, name) for name in ("command_low", "command_high")}


def seconds(stamp: Any) -> float:
    """Return a message's time stamp in s."""
    return stamp.sec + stamp.nanosec * 1e-9


def wrong_time(sample: Sample, topic: str, parameters: Any, name: str) -> str:
    """Say what is wrong with the time of a sample for a node that runs with `parameters`; empty: nothing."""
    h = parameters.sample_time
    if sample.period and abs(sample.period - h) > 1e-6 * h:
        return f"'{topic}' comes every {sample.period:g} s, must come at the sample time of '{name}': {h:g} s"
    stamp = seconds(sample.header.stamp)
    if stamp and (stamp > SIMULATED_TIME) != (parameters.mode == "free_running"):
        other = "free_running" if stamp > SIMULATED_TIME else "lockstep"
        return f"'{topic}' is sent in mode '{other}', '{name}' is in mode '{parameters.mode}'"
    return ""


def stray(sample: Sample, topic: str, expected: int) -> str:
    """Say that a sample is none of the count of its topic."""
    return f"'{topic}' brought sample {sample.number}, expected {expected}: does another node answer this topic?"


def too_old(sample: Sample, topic: str, age_limit: float) -> str:
    """Say that a sample is older than `age_limit` (s), if its stamp says so; empty: it is not."""
    stamp = seconds(sample.header.stamp)
    age = time.time() - stamp
    if not stamp or age <= age_limit:
        return ""
    return f"'{topic}' sample {sample.number} is {age:.2g} s old, must be at most {age_limit:g} s; not acted upon"


class BlockNode(FingerNode):
    """Subscribe `INPUT`, publish `OUTPUT`; a subclass says what becomes of a value."""

    INPUT: str
    OUTPUT: str
    LARGEST: float
    """Size of the input beyond which it is a mistake."""
    MOVES_VOLTAGE: bool

    def __init__(self) -> None:
        super().__init__()
        self.answers = SampleOutput(self, self.OUTPUT)
        self.faults = self.create_publisher(Fault, "fault", FAULTS)
        self.last = Sample()
        self.sequence = Sequence()
        self.guard = Guard(hold_time=1.0)
        self._answers = False
        self._waiting: tuple[Sample, str] | None = None  # a sample, and what it waits for
        self.finger: FingerState | None = None
        self.create_subscription(FingerState, "state", self._hear_state, LATCHED)
        self._input = SoleInput(
            self, self.INPUT, self._on_sample, self._quality(), self._look_at_input
        )

    def restart(self) -> None:
        """Take up a new run, before its first sample."""
        raise NotImplementedError

    def prepare(self, sample: Sample) -> str:
        """Take up what else the answer to a sample of lock-step depends on; return what is still missing of it."""
        return ""

    def go_on(self) -> None:
        """Answer the sample that waits, if there is one, now that something has come."""
        if self._waiting:
            self._on_sample(self._waiting[0])

    def compute(self, sample: Sample, answer: Sample) -> bool:
        """Write the answer to a sample, or say that there is none."""
        raise NotImplementedError

    def trip(self, cause: str) -> None:
        """Latch a fault."""
        if not self.guard.is_latched:
            self.get_logger().error(f"{cause}; no more answers; {self.way_on()}")
            self._answers = False
        self.guard.trip(cause, time.monotonic(), at_rest=not self.MOVES_VOLTAGE)
        self._tell()

    def _tell(self) -> None:
        """Say on `fault` and `/diagnostics` what is latched."""
        fault = Fault(node=self.get_name(), times=self.guard.times)
        if self.guard.is_latched:
            fault.text = self.guard.cause
        fault.header.stamp = base.wall_time(self.guard.since)
        self.faults.publish(fault)
        self.publish_diagnostics()

    def start(self) -> None:
        if self._input.qos is not self._quality():  # the mode was changed
            self._input.close()
            self._input = SoleInput(
                self, self.INPUT, self._on_sample, self._quality(), self._look_at_input
            )
        self.sequence = Sequence(gaps=self.parameters.mode == "free_running")
        self._answers = False
        self._waiting = None
        self.say(f"waits for '{self.resolve_topic_name(self.INPUT)}'")
        self._rearm()

    def reset(self) -> None:
        self._rearm()
        if self.guard.is_latched:
            raise ValueError(self.guard.cause)

    def _rearm(self) -> None:
        self.guard.reset()
        if wrong := self._input.wrong():
            self.trip(wrong)
        else:
            self._tell()

    def report(self) -> tuple[str, dict[str, Any]]:
        wrong = self.guard.cause
        if self._waiting and not wrong:
            sample, missing = self._waiting
            wrong = f"sample {sample.number} waits for {missing}"
        return wrong, {"sample": self.sequence.next - 1, **base.told(self.guard)}

    def _quality(self) -> QoSProfile:
        return SAMPLE if self.parameters.mode == "lockstep" else NEWEST

    def _look_at_input(self) -> None:
        if self.active and (wrong := self._input.wrong()):
            self.trip(wrong)

    def _hear_state(self, state: FingerState) -> None:
        """Take a state, unless nonsense is in what a block begins with; a reference may be unknown."""
        reference = 0.0 if math.isnan(state.reference) else state.reference
        values = (
            ("voltage", "V", state.voltage, -LARGEST_VOLTAGE, LARGEST_VOLTAGE),
            ("reference", "m", reference, -LARGEST_DEFLECTION, LARGEST_DEFLECTION),
            ("max_force", "N", state.max_force, 0.0, LARGEST_FORCE),
        )
        for name, unit, value, low, high in values:
            if not low <= value <= high:
                self.get_logger().error(
                    f"'state' has a {name} of {value} {unit}, must be in [{low:g}, {high:g}] {unit}; ignored",
                    throttle_duration_sec=1.0,
                )
                return
        self._on_state(state)

    def _on_state(self, state: FingerState) -> None:
        self.finger = state

    def _is_new_run(self) -> bool:
        """Say whether a sample 0 may begin a run: not in the middle of one, as the finger's state has it."""
        return (
            self.sequence.next <= 0
            or self.finger is None
            or self.finger.phase != FingerState.RUNNING
            or self.finger.samples <= 1
        )

    def _on_sample(self, sample: Sample) -> None:
        self._waiting = None
        if not self.active or self.guard.is_latched:
            return
        # Before its number is looked at: another loop counts otherwise, and a stray number is only said.
        if wrong := wrong_time(sample, self.INPUT, self.parameters, self.NAME):
            self.trip(wrong + self._input.others())
            return
        number = sample.number
        lockstep = self.parameters.mode == "lockstep"
        kind = self.sequence.classify(number)
        if kind == REPEATED and lockstep:
            self.answers.publish(self.last)
            return
        if kind == STRAY and self.sequence.begins_anew(number):
            self.get_logger().warning(
                f"'{self.INPUT}' counts anew, from sample {number} on: a new run"
            )
            self.restart()
        elif kind == STRAY or kind == REPEATED:
            words = stray(sample, self.INPUT, max(self.sequence.next, 0)) + self._input.others()
            self.get_logger().error(words, throttle_duration_sec=1.0)
            return
        if kind == FIRST and lockstep:
            if not self._is_new_run():
                self.get_logger().error(
                    f"'{self.INPUT}' brought sample 0 in the middle of a run; ignored",
                    throttle_duration_sec=1.0,
                )
                return
            readers = self.answers.readers()
            if readers < self.parameters.subscribers:
                self.say(
                    f"waits for {self.parameters.subscribers} subscribers of '{self.answers.name}': "
                    f"{readers} are there"
                )
                return  # the cantilever asks again
        if not is_physical(sample.value, self.LARGEST):
            self.get_logger().error(
                f"'{self.INPUT}' sample {number} is {sample.value}, must be finite and within "
                f"±{self.LARGEST:g}; not answered{self._input.others()}",
                throttle_duration_sec=1.0,
            )
            return
        if not lockstep and (old := too_old(sample, self.INPUT, self.parameters.age_limit)):
            self.get_logger().error(old, throttle_duration_sec=1.0)
            return
        if lockstep and (missing := self.prepare(sample)):
            self._waiting = sample, missing
            return
        if kind == FIRST and lockstep and self.sequence.next != 0:
            self.restart()
        self.sequence.count(number)
        answer = Sample(header=sample.header, number=number, period=self.parameters.sample_time)
        if self.compute(sample, answer):
            self.answers.publish(answer)
            self.last = answer
            if not self._answers:
                self._answers = True
                self.say(f"answers '{self.resolve_topic_name(self.INPUT)}'")
