# SPDX-License-Identifier: Apache-2.0
"""One sample of the servo: from a reading to a voltage, with everything that guards the finger.

    reading -> deflection -> K -> H_s⁻¹ with its limits -> voltage

The laws are those of the nodes (:mod:`piezo_control.feedback`, :mod:`piezo_control.feedforward`,
:mod:`piezo_control.safety`). What the certificate does not cover ends at rest and stays there until a reset:
a sensor that is silent, old, frozen or out of its range, a deflection that the model cannot explain, a loop that
oscillates, periods that are late or missed, a device that is gone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from piezo_control.compiled import as_arrays
from piezo_control.feedback import (
    FeedbackCoefficients,
    FeedbackParameters,
    FeedbackState,
    feedback_coefficients,
    feedback_step,
    hand_over,
)
from piezo_control.feedforward import (
    Feedforward,
    FeedforwardCoefficients,
    FeedforwardParameters,
    FeedforwardState,
    feedforward_step,
    modelled_deflection,
)
from piezo_control.hysteresis import inverse_follow
from piezo_control.parameters import ParameterError
from piezo_control.safety import (
    FAULT,
    HOLDING,
    LARGEST_DEFLECTION,
    NORMAL,
    RAMPING,
    Limits,
    is_physical,
    limits,
    toward,
)
from piezo_control.servo.driver import FAILED, FRESH
from piezo_control.servo.parameters import ServoParameters

LARGEST_ORDER = 32


# Causes of a fault, and what each says of the value that was seen.
(
    NO_CAUSE, SENSOR_SILENT, SENSOR_OLD, SENSOR_FROZEN, SENSOR_RANGE, MODEL, CYCLE, MISSED, LATE, DEVICE,
    STOPPED,
) = range(11)  # fmt: skip

CAUSES: dict[int, Callable[[float, ServoParameters], str]] = {
    SENSOR_SILENT: lambda v, p: f"no reading of the sensor for {p.hold_time:g} s",
    SENSOR_OLD: lambda v, p: f"readings are {v:.3g} s old, must be at most {p.age_limit:g} s",
    SENSOR_FROZEN: lambda v, p: (
        f"the sensor's reading stands still at {v * 1e6:.3f} µm for {p.frozen_time:g} s while the voltage "
        f"moved by {p.frozen_voltage:g} V"
    ),
    SENSOR_RANGE: lambda v, p: (
        f"the sensor says {v * 1e6:.4g} µm, must be within [{p.sensor_low * 1e6:g}, "
        f"{p.sensor_high * 1e6:g}] µm"
    ),
    MODEL: lambda v, p: (
        f"the deflection is {v * 1e6:.3g} µm from what the model says of the voltage, must be within "
        f"{p.model_tolerance * 1e6:g} µm: polarity, scale or wiring?"
    ),
    CYCLE: lambda v, p: (
        f"the loop oscillates by {v * 1e6:.3g} µm, must stay below {p.cycle_amplitude * 1e6:g} µm"
    ),
    MISSED: lambda v, p: f"{v:.0f} periods missed in a row, must be at most {p.missed_limit}",
    LATE: lambda v, p: (
        f"{v:.1%} of the periods are late or missed, must be at most {p.late_share:.1%}"
    ),
    DEVICE: lambda v, p: "the device failed; its voltage may not be at rest",
    STOPPED: lambda v, p: "stopped",
}


class Settings(NamedTuple):
    """The servo's parameters in samples, and the limits of the voltage."""

    sample_time: float
    sensor_scale: float
    sensor_zero: float
    sensor_low: float
    sensor_high: float
    age_limit: float
    hold_samples: float
    frozen_samples: float
    frozen_voltage: float
    model_tolerance: float
    cycle_amplitude: float
    window: int
    missed_limit: float
    late_share: float
    voltage: Limits


class Controller(NamedTuple):
    """A controller with room for `LARGEST_ORDER` states; one-element arrays hold what is one number."""

    order: np.ndarray
    a: np.ndarray
    b: np.ndarray
    c: np.ndarray
    d: np.ndarray
    reference_b: np.ndarray
    reference_d: np.ndarray
    anti_windup: np.ndarray
    command_low: np.ndarray
    command_high: np.ndarray
    hand_over: np.ndarray  # (order, 3), row by row


class Laws(NamedTuple):
    """The laws of a finger: two controllers, one in use and one to change to, and H_s⁻¹."""

    controllers: tuple[Controller, Controller]
    states: FeedbackState  # of the controller in use
    feedforward: FeedforwardCoefficients
    feedforward_state: FeedforwardState


class Watch(NamedTuple):
    """What the servo remembers to judge the loop by; arrays of one number, changed in place."""

    phase: np.ndarray
    cause: np.ndarray
    cause_value: np.ndarray
    times: np.ndarray  # faults since the last reset
    silent: np.ndarray  # samples without a reading
    raw: np.ndarray  # the last reading, in the card's unit
    same: np.ndarray  # samples since it changed
    raw_voltage: np.ndarray  # the voltage at which it changed
    command: np.ndarray
    in_use: np.ndarray  # which controller; -1 before the first sample
    samples: np.ndarray  # of this window
    lowest: np.ndarray  # error
    highest: np.ndarray
    middle: np.ndarray  # of the error in the last window
    side: np.ndarray  # of the middle, where the error is
    crossings: np.ndarray
    reference_lowest: np.ndarray
    reference_highest: np.ndarray
    cycles: np.ndarray  # windows in a row that oscillate
    windows: np.ndarray  # windows of the present judgement of lateness
    late: np.ndarray  # late and missed periods in it
    periods: np.ndarray


def settings_of(
    parameters: ServoParameters, feedforward: FeedforwardParameters, sample_time: float
) -> Settings:
    """Return the settings of the loop at this sample time (s)."""
    p = parameters
    return Settings(
        sample_time,
        p.sensor_scale,
        p.sensor_zero,
        p.sensor_low,
        p.sensor_high,
        p.age_limit,
        p.hold_time / sample_time,
        p.frozen_time / sample_time,
        p.frozen_voltage,
        p.model_tolerance,
        p.cycle_amplitude,
        max(2, round(p.window / sample_time)),
        float(p.missed_limit),
        p.late_share,
        limits(feedforward, p.ramp),
    )


def empty_controller() -> Controller:
    """Return room for a controller."""
    n = LARGEST_ORDER
    one = [np.zeros(1) for _ in range(4)]
    return Controller(
        np.zeros(1, dtype=np.int64), np.zeros(n * n), np.zeros(n), np.zeros(n), one[0], np.zeros(n),
        one[1], np.zeros(n), one[2], one[3], np.zeros(3 * n),
    )  # fmt: skip


def put_controller(room: Controller, parameters: FeedbackParameters) -> None:
    """Put a controller into the `room` of one that is not in use.

    Raises ParameterError for more than `LARGEST_ORDER` states, and as :func:`hand_over`.
    """
    if parameters.order > LARGEST_ORDER:
        raise ParameterError(
            f"controller '{parameters.name}' has {parameters.order} states, must have at most {LARGEST_ORDER}"
        )
    matrix = hand_over(parameters)
    room.order[0] = parameters.order
    for name, value in feedback_coefficients(parameters)._asdict().items():
        values = np.ravel(value)
        getattr(room, name)[: len(values)] = values
    room.hand_over[: matrix.size] = matrix.ravel()


def laws_of(feedback: FeedbackParameters, feedforward: Feedforward) -> Laws:
    """Return the laws of a finger at rest."""
    controllers = (empty_controller(), empty_controller())
    put_controller(controllers[0], feedback)
    return Laws(
        controllers,
        as_arrays(FeedbackState([0.0] * LARGEST_ORDER, [0.0] * LARGEST_ORDER)),
        as_arrays(feedforward.coefficients),
        as_arrays(feedforward.state),
    )


def watch_at_rest() -> Watch:
    """Return the memory of a servo that has not begun."""
    watch = Watch(*(np.zeros(1) for _ in Watch._fields))
    watch.in_use[0] = -1.0
    watch.raw[0] = math.nan
    return watch


# Step functions: plain numbers and indexables, so that numba can compile them as they are.


def trip(w: Watch, cause: int, value: float) -> None:
    """Latch a fault; the first cause is kept."""
    w.times[0] += 1.0
    if w.phase[0] == NORMAL or w.phase[0] == HOLDING:
        w.phase[0] = RAMPING
        w.cause[0] = cause
        w.cause_value[0] = value


def rearm(w: Watch) -> None:
    """Leave a fault; the controller takes over where the finger is."""
    w.phase[0] = NORMAL
    w.cause[0] = NO_CAUSE
    w.times[0] = 0.0
    w.silent[0] = 0.0
    w.raw[0] = math.nan
    w.in_use[0] = -1.0
    w.samples[0] = 0.0
    w.cycles[0] = 0.0
    w.windows[0] = 0.0
    w.late[0] = 0.0
    w.periods[0] = 0.0


def servo_step(
    c: Settings,
    laws: Laws,
    w: Watch,
    wanted: int,
    status: int,
    raw: float,
    age: float,
    reference: float,
    share: float,
) -> float:
    """Return the voltage (V) of one sample.

    `wanted` is the controller to use (0 or 1), `status` and `raw` what the card returned and read, `age` the
    age of that (s), `reference` in m. `share` (0 to 1) is the part of a sample time from the last voltage to
    this one at the actuator, so that the slew limit holds in time.
    """
    last = laws.feedforward_state.hysteresis.voltage[0]
    if status == FAILED:
        trip(w, DEVICE, 0.0)
    elif status == FRESH:
        w.silent[0] = 0.0
        judge_reading(c, w, raw, age, last)
        judge_model(c, laws, w, raw)
    else:
        w.silent[0] += 1.0
        if w.silent[0] > c.hold_samples:
            trip(w, SENSOR_SILENT, 0.0)
        elif w.phase[0] == NORMAL:
            w.phase[0] = HOLDING
    if w.phase[0] == RAMPING or w.phase[0] == FAULT:
        return ramp(c, laws, w, last, share)
    if status != FRESH:
        return last
    w.phase[0] = NORMAL
    deflection = c.sensor_scale * (raw - c.sensor_zero)
    k = laws.controllers[wanted]
    order = k.order[0]
    x = laws.states.x[:order]
    if w.in_use[0] != wanted:
        # A new controller begins with the command at which the finger is: no bump. The first one begins as if
        # the reference had been where the finger is, so that a reference elsewhere is a step.
        command = modelled_deflection(laws.feedforward, laws.feedforward_state)
        command = min(max(command, k.command_low[0]), k.command_high[0])
        before = deflection if w.in_use[0] < 0.0 else reference
        for i in range(order):
            x[i] = (
                k.hand_over[3 * i] * before
                + k.hand_over[3 * i + 1] * deflection
                + k.hand_over[3 * i + 2] * command
            )
        w.in_use[0] = wanted
    coefficients = FeedbackCoefficients(
        k.a[: order * order],
        k.b[:order],
        k.c[:order],
        k.d[0],
        k.reference_b[:order],
        k.reference_d[0],
        k.anti_windup[:order],
        k.command_low[0],
        k.command_high[0],
    )
    state = FeedbackState(x, laws.states.x_next[:order])
    w.command[0] = feedback_step(coefficients, state, reference, deflection)
    judge_loop(c, w, reference, reference - deflection)
    return feedforward_step(laws.feedforward, laws.feedforward_state, w.command[0], share)


def judge_reading(c: Settings, w: Watch, raw: float, age: float, voltage: float) -> None:
    """Trip on a reading that is too old, out of range or frozen."""
    deflection = c.sensor_scale * (raw - c.sensor_zero)
    if raw != w.raw[0]:
        w.raw[0] = raw
        w.raw_voltage[0] = voltage
        w.same[0] = 0.0
    w.same[0] += 1.0
    if not is_physical(deflection, LARGEST_DEFLECTION) or not (
        c.sensor_low <= deflection <= c.sensor_high
    ):
        trip(w, SENSOR_RANGE, deflection)
    elif age > c.age_limit:
        trip(w, SENSOR_OLD, age)
    elif w.same[0] > c.frozen_samples and abs(voltage - w.raw_voltage[0]) > c.frozen_voltage:
        trip(w, SENSOR_FROZEN, deflection)


def judge_model(c: Settings, laws: Laws, w: Watch, raw: float) -> None:
    """Trip on a deflection that the voltage cannot explain."""
    modelled = modelled_deflection(laws.feedforward, laws.feedforward_state)
    apart = c.sensor_scale * (raw - c.sensor_zero) - modelled
    if abs(apart) > c.model_tolerance:
        trip(w, MODEL, apart)


def judge_loop(c: Settings, w: Watch, reference: float, error: float) -> None:
    """Trip on an error that keeps swinging, window after window, while the reference does not."""
    if w.samples[0] == 0.0:
        w.lowest[0] = w.highest[0] = error
        w.reference_lowest[0] = w.reference_highest[0] = reference
        w.crossings[0] = 0.0
    w.samples[0] += 1.0
    w.lowest[0] = min(w.lowest[0], error)
    w.highest[0] = max(w.highest[0], error)
    w.reference_lowest[0] = min(w.reference_lowest[0], reference)
    w.reference_highest[0] = max(w.reference_highest[0], reference)
    side = 1.0 if error > w.middle[0] else -1.0
    if side != w.side[0]:
        w.side[0] = side
        w.crossings[0] += 1.0
    if w.samples[0] < c.window:
        return
    swing = w.highest[0] - w.lowest[0]
    moved = w.reference_highest[0] - w.reference_lowest[0]
    w.middle[0] = 0.5 * (w.highest[0] + w.lowest[0])
    w.samples[0] = 0.0
    if swing > c.cycle_amplitude and w.crossings[0] >= 4.0 and moved < 0.5 * swing:
        w.cycles[0] += 1.0
        if w.cycles[0] >= 5.0:
            trip(w, CYCLE, swing)
    else:
        w.cycles[0] = 0.0


def judge_time(c: Settings, w: Watch, late: float, missed: float) -> None:
    """Trip on missed and late periods; `late` (s) is how late this one began."""
    if missed > c.missed_limit:
        trip(w, MISSED, missed)
    w.periods[0] += 1.0 + missed
    w.late[0] += missed
    if late > 0.5 * c.sample_time:
        w.late[0] += 1.0
    if w.periods[0] >= 5.0 * c.window:
        share = w.late[0] / w.periods[0]
        w.periods[0] = 0.0
        w.late[0] = 0.0
        if share > c.late_share:
            trip(w, LATE, share)


def ramp(c: Settings, laws: Laws, w: Watch, last: float, share: float) -> float:
    """Return the next voltage (V) on the way to rest, at the end of which the fault is latched."""
    voltage = toward(c.voltage.rest, c.voltage.ramp * c.sample_time * share, last)
    f = laws.feedforward
    inverse_follow(f.operator, f.inverse, laws.feedforward_state.hysteresis, voltage)
    if voltage == c.voltage.rest:
        w.phase[0] = FAULT
    return voltage
