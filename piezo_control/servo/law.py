# SPDX-License-Identifier: Apache-2.0
"""One sample of the servo: from a reading to a voltage, with everything that guards the finger.

    reading -> deflection -> K -> H_s⁻¹ with its limits -> voltage

The laws are those of the nodes (:mod:`piezo_control.feedback`, :mod:`piezo_control.feedforward`,
:mod:`piezo_control.safety`). A servo that feels has the law of :mod:`piezo_control.touch` in place of K; what it
expects of a tip that nobody pushes the models of :mod:`piezo_control.sensorless` say, which follow its voltage.

What the certificate does not cover ends at rest and stays there until a reset: a sensor that is silent, old, frozen
or out of its range, a deflection that the model cannot explain, a loop that oscillates, periods that are late or
missed, a device that is gone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
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
    uncovered,
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
from piezo_control.sensorless import (
    SensorlessCoefficients,
    SensorlessParameters,
    SensorlessState,
    follow_step,
    sensorless_coefficients,
    sensorless_rest,
    settle,
)
from piezo_control.servo.driver import FRESH, NONE_IN_TIME
from piezo_control.servo.parameters import ServoParameters
from piezo_control.shaping import ShapingParameters
from piezo_control.thermal import REFERENCE_DEGC
from piezo_control.touch import (
    TouchCoefficients,
    TouchParameters,
    TouchState,
    feel,
    press,
    touch_coefficients,
    touch_rest,
    touch_start,
)

LARGEST_ORDER = 32


# Causes of a fault, and what each says of the value that was seen.
(
    NO_CAUSE, SENSOR_SILENT, SENSOR_OLD, SENSOR_FROZEN, SENSOR_RANGE, MODEL, CYCLE, MISSED, LATE, DEVICE,
    STOPPED, TEMPERATURE, NOT_WRITTEN,
) = range(13)  # fmt: skip

CAUSES: dict[int, Callable[[float, ServoParameters], str]] = {
    SENSOR_SILENT: lambda v, p: f"no reading of the sensor for {p.hold_time:g} s",
    SENSOR_OLD: lambda v, p: f"readings are {v:.3g} s old, must be within [0, {p.age_limit:g}] s",
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
    TEMPERATURE: lambda v, p: "the temperature is missing or frozen",
    NOT_WRITTEN: lambda v, p: f"the device took no voltage for {p.hold_time:g} s",
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
    feels: bool


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


class Feeling(NamedTuple):
    """What tells the push of an object and holds it; arrays of one number change in place."""

    models: SensorlessCoefficients
    models_state: SensorlessState
    touch: TouchCoefficients
    touch_state: TouchState
    expected: np.ndarray  # m, this reading if nobody pushes
    temperature: np.ndarray  # °C, NaN: none is known
    is_settled: np.ndarray  # 0 before the first temperature
    max_force: np.ndarray  # N


class Laws(NamedTuple):
    """The laws of a finger: two controllers, one in use and one to change to, H_s⁻¹, and what feels."""

    controllers: tuple[Controller, Controller]
    states: FeedbackState  # of the controller in use
    feedforward: FeedforwardCoefficients
    feedforward_state: FeedforwardState
    feeling: Feeling


class Watch(NamedTuple):
    """What the servo remembers to judge the loop by; arrays of one number, changed in place."""

    phase: np.ndarray
    cause: np.ndarray
    cause_value: np.ndarray
    times: np.ndarray  # faults since the last reset
    silent: np.ndarray  # samples without a reading
    unwritten: np.ndarray  # voltages in a row that did not go out
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
    parameters: ServoParameters,
    feedforward: FeedforwardParameters,
    sample_time: float,
    feels: bool = False,
) -> Settings:
    """Return the settings of the loop at this sample time (s); where it `feels`, touch is in place of K."""
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
        feels,
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


def feeling_of(
    touch: TouchParameters, models: SensorlessParameters, feedback: FeedbackParameters, degc: float
) -> Feeling:
    """Return what feels for a finger at rest at `degc` (°C), with sample time and command range of `feedback`.

    Raises ParameterError for models that have no inverse or no elastic constant.
    """
    h = feedback.sample_time
    # The models follow a voltage here, and never shape a reference.
    coefficients = sensorless_coefficients(replace(models, shaping=ShapingParameters("none")), h)
    return Feeling(
        as_arrays(coefficients),
        as_arrays(sensorless_rest(coefficients, degc)),
        touch_coefficients(
            touch,
            models.dynamics.elastic_constant,
            h,
            feedback.command_low,
            feedback.command_high,
        ),
        as_arrays(touch_rest()),
        expected=np.zeros(1),
        temperature=np.full(1, math.nan),
        is_settled=np.zeros(1),
        max_force=np.full(1, touch.force_limit),
    )


def laws_of(
    feedback: FeedbackParameters, feedforward: Feedforward, feeling: Feeling | None = None
) -> Laws:
    """Return the laws of a finger at rest; without `feeling` the paper's, which nobody asks."""
    controllers = (empty_controller(), empty_controller())
    put_controller(controllers[0], feedback)
    if feeling is None:
        models = SensorlessParameters()
        feeling = feeling_of(TouchParameters(), models, feedback, REFERENCE_DEGC)
    return Laws(
        controllers,
        as_arrays(FeedbackState([0.0] * LARGEST_ORDER, [0.0] * LARGEST_ORDER)),
        as_arrays(feedforward.coefficients),
        as_arrays(feedforward.state),
        feeling,
    )


def objections(
    feedback: FeedbackParameters, feedforward: FeedforwardParameters, denominator: Sequence[float]
) -> list[str]:
    """Return what speaks against running the controller on the finger with this D(s), in words; empty: nothing."""
    reach = Feedforward(feedforward, feedback.sample_time).reachable_range
    sensorless = False  # under a controller the servo undoes the hysteresis only
    return uncovered(feedback, feedback.delay_samples, denominator, reach, sensorless)


def watch_at_rest() -> Watch:
    """Return the memory of a servo that has not begun."""
    watch = Watch(*(np.zeros(1) for _ in Watch._fields))
    watch.in_use[0] = -1.0
    watch.raw[0] = math.nan
    return watch


# Step functions: plain numbers and indexables, so that numba can compile them as they are.


def trip(w: Watch, cause: int, value: float) -> None:
    """Latch a fault; the first cause is kept, but for a device that is gone, which may never come to rest."""
    w.times[0] += 1.0
    if w.cause[0] == NO_CAUSE or cause == DEVICE:
        w.cause[0] = cause
        w.cause_value[0] = value
    if w.phase[0] == NORMAL or w.phase[0] == HOLDING:
        w.phase[0] = RAMPING


def rearm(w: Watch) -> None:
    """Leave a fault; the controller takes over where the finger is."""
    w.phase[0] = NORMAL
    w.cause[0] = NO_CAUSE
    w.times[0] = 0.0
    w.silent[0] = 0.0
    w.unwritten[0] = 0.0
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
    """Return the voltage (V) of one sample; the models of a finger that feels follow the one before.

    `wanted` is the controller to use (0 or 1), `status` and `raw` what the card returned and read, `age` the
    age of that (s), `reference` in m. `share` (0 to 1) is the part of a sample time from the last voltage to
    this one at the actuator, so that the slew limit holds in time.
    """
    last = laws.feedforward_state.hysteresis.voltage[0]
    if c.feels:
        expect(laws.feeling, last)
    if status == FRESH:
        w.silent[0] = 0.0
        judge_reading(c, w, raw, age, last)
        judge_model(c, laws, w, raw)
    elif status == NONE_IN_TIME:
        w.silent[0] += 1.0
        hold(c, w, w.silent[0], SENSOR_SILENT)
    else:
        trip(w, DEVICE, 0.0)
    if w.phase[0] == RAMPING or w.phase[0] == FAULT:
        return ramp(c, laws, w, last, share)
    if status != FRESH or w.unwritten[0] > 0.0:
        return last
    w.phase[0] = NORMAL
    deflection = c.sensor_scale * (raw - c.sensor_zero)
    if c.feels:
        w.command[0] = touch(laws, w, wanted, reference, deflection)
    else:
        w.command[0] = control(laws, w, wanted, reference, deflection)
    judge_loop(c, w, reference, reference - deflection)
    return feedforward_step(laws.feedforward, laws.feedforward_state, w.command[0], share)


def hold(c: Settings, w: Watch, missing: float, cause: int) -> None:
    """Hold the voltage while something is missing, and trip after so many samples as the hold time has."""
    if missing > c.hold_samples:
        trip(w, cause, 0.0)
    elif w.phase[0] == NORMAL:
        w.phase[0] = HOLDING


def judge_write(c: Settings, laws: Laws, w: Watch, status: int, before: float) -> None:
    """Take note of what the card returned for a voltage; one that did not go out leaves the finger `before` it (V)."""
    if status == FRESH:
        w.unwritten[0] = 0.0
        return
    follow(laws, before)
    w.unwritten[0] += 1.0
    if status == NONE_IN_TIME:
        hold(c, w, w.unwritten[0], NOT_WRITTEN)
    else:
        trip(w, DEVICE, 0.0)


def follow(laws: Laws, voltage: float) -> None:
    """Let the models go where the finger goes under `voltage` (V)."""
    f = laws.feedforward
    inverse_follow(f.operator, f.inverse, laws.feedforward_state.hysteresis, voltage)


def touch(laws: Laws, w: Watch, wanted: int, reference: float, deflection: float) -> float:
    """Return the command (m) that follows the reference and pushes with no more than is allowed."""
    f = laws.feeling
    if w.in_use[0] < 0.0:
        command = modelled_deflection(laws.feedforward, laws.feedforward_state)
        touch_start(f.touch_state, command, deflection, f.expected[0])
        w.in_use[0] = wanted
    feel(f.touch, f.touch_state, f.expected[0], deflection, f.max_force[0])
    return press(f.touch, f.touch_state, reference, deflection, f.max_force[0])


def expect(f: Feeling, voltage: float) -> None:
    """Let the models follow the voltage (V) that led to this reading, and keep what they expect of it."""
    degc = f.temperature[0]
    if f.is_settled[0] == 0.0 and degc == degc:  # not NaN
        settle(f.models, f.models_state, degc)
        f.is_settled[0] = 1.0
    f.expected[0] = follow_step(f.models, f.models_state, voltage, degc)


def control(laws: Laws, w: Watch, wanted: int, reference: float, deflection: float) -> float:
    """Return the command (m) of the controller, which takes over here if it was another before."""
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
    return feedback_step(coefficients, state, reference, deflection)


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
    elif not 0.0 <= age <= c.age_limit:
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
    """Return the next voltage (V) on the way to rest, where a fault is latched and a loop without one begins."""
    if last == c.voltage.rest:  # it has gone out
        w.phase[0] = NORMAL if w.cause[0] == NO_CAUSE else FAULT
    voltage = toward(c.voltage.rest, c.voltage.ramp * c.sample_time * share, last)
    follow(laws, voltage)
    return voltage
