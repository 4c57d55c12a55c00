# SPDX-License-Identifier: Apache-2.0
"""Samples of the servo's law for exported firmware to be compared with.

The loop is closed around the finger that the parameters describe, with steps, slow and impossible
references, and each kind of fault that can be provoked in the time there is.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from piezo_control.dynamics import DynamicsParameters, Motion, move, propagator
from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.hysteresis import Hysteresis
from piezo_control.safety import FAULT
from piezo_control.servo.driver import FAILED, FRESH, NONE_IN_TIME
from piezo_control.servo.law import (
    STOPPED,
    laws_of,
    rearm,
    servo_step,
    settings_of,
    trip,
    watch_at_rest,
)
from piezo_control.servo.parameters import ServoParameters

GO_ON, RESET, STOP = range(3)
SAMPLES = 1500
FROZEN = 1320  # from this sample on, the sensor's reading stands still
REFERENCES = (0.45, -0.7, 1.6, -1.6, 0.1)
"""Steps of the reference, as parts of the command's limits."""


class Vector(NamedTuple):
    """One sample: what comes in (the reading in the card's unit) and what the law makes of it."""

    action: int  # before the sample: GO_ON, RESET or STOP
    status: int
    reading: float
    reference: float  # m
    voltage: float  # V
    command: float  # m
    phase: int
    cause: int


def vectors(
    servo: ServoParameters, feedback: FeedbackParameters, feedforward: FeedforwardParameters
) -> list[Vector]:
    """Return `SAMPLES` samples of a finger in closed loop, from rest.

    A reference that is no number is one that the firmware must not act upon; the law gets the one before.
    """
    h = feedback.sample_time
    settings = settings_of(servo, feedforward, h)
    laws = laws_of(feedback, Feedforward(feedforward, h))
    watch = watch_at_rest()
    actuator = Hysteresis(feedforward.hysteresis, h)
    inertia, damping, stiffness = feedback.denominator or DynamicsParameters().denominator
    free = propagator(inertia, damping, stiffness, h)
    motion = Motion([0.0], [0.0])
    delayed = deque([0.0] * (1 + feedback.delay_samples))
    found = []
    last = 0.0
    for n in range(SAMPLES):
        deflection = delayed.popleft()
        reading = servo.sensor_zero + deflection / servo.sensor_scale
        action, status, reading = _event(n, reading, int(watch.phase[0]))
        if n >= FROZEN:
            reading = servo.sensor_zero
        if action == RESET:
            rearm(watch)
        elif action == STOP:
            trip(watch, STOPPED, 0.0)
        reference = _reference(n, feedback)
        last = last if math.isnan(reference) else reference
        voltage = float(servo_step(settings, laws, watch, 0, status, reading, 0.0, last, 1.0))
        move(motion, free, actuator.step(voltage))
        delayed.append(motion.x[0])
        found.append(
            Vector(
                action, status, reading, reference, voltage, float(watch.command[0]),
                int(watch.phase[0]), int(watch.cause[0]),
            )
        )  # fmt: skip
    return found


def _reference(n: int, feedback: FeedbackParameters) -> float:
    """Return the reference (m) of sample `n`: a step every 100 samples, a slow sine on top, and no number."""
    if n % 211 == 7:
        return math.nan
    part = REFERENCES[n // 100 % len(REFERENCES)] + 0.05 * math.sin(0.05 * n)
    return part * (feedback.command_high if part > 0.0 else -feedback.command_low)


def _event(n: int, reading: float, phase: int) -> tuple[int, int, float]:
    """Return action, status and reading of sample `n`, whose sensor says `reading`."""
    if phase == FAULT and n % 50 == 0:
        return RESET, FRESH, reading
    if n == 700:
        return STOP, FRESH, reading
    if n == 900:
        return GO_ON, FRESH, math.nan
    if n == 1100:
        return GO_ON, FAILED, reading
    if n in (60, 61, 62) or 1200 <= n < 1300:
        return GO_ON, NONE_IN_TIME, reading
    return GO_ON, FRESH, reading
