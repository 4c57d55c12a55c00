# SPDX-License-Identifier: Apache-2.0
"""Force without a force sensor, and a finger that stops at a force and holds it, whatever it touches.

The models of hysteresis, heat and creep say where a tip that nobody pushes would be (paper eq. 3 with F = 0,
:mod:`piezo_control.sensorless`). What is missing of it, low-passed, is the push of the object:

    push = (lowpass(expected - deflection) - zero) / s_p.

Of what is missing, the models may be off by two parts, `zero` = `share` + `drift`, which are learned while less than
`touch_force` and half of what is allowed is felt:

- `share` of the way that the command has gone: it follows by up to `model_error` times the way. What a hysteresis is
  off by returns where its input returns (the return-point memory), so a command that comes back to where it once
  turned brings back at most the `share` of that turn: a reference that shakes learns no force away.
- `drift` with time: slowly, and not while the reference closes, when a rise may be an object.

Both follow without a bound where something pulls, on the way and at rest, which no object does here (an adhesive one
would be felt late), but no faster than a vibration, of which they would take one half only. What they learned since
nothing pushed last was the object: they give it back when that is felt.

What the models are off by on the way in contact is the error of the push, for which a share of what is allowed is left
free; an object so soft that a tip loses less than `model_error` of its way on it is not felt.

The command integrates the slower of two wishes, to follow the reference and to push with `max_force`:

    command' = min(reference' + position_rate lowpass(reference - deflection),
                   force_rate s_p ((1 - force_margin) max_force - push)),

and opens no faster than force_rate s_p force_limit, so that a reference that jumps does not make it ring.
There is one integrator, so one wish takes over from the other without a bump, and a finger comes no faster than
it can stop: a tip that closes at force_rate s_p max_force meets a wall and the push goes to the limit
exponentially. In contact with a stiffness k the static gain of the first is 1 / (1 + s_p k), that of the second
s_p k / (1 + s_p k), and the resonance of the tip is at sqrt(1 + s_p k) times its own, where an integrator behind a low-pass
has less gain than at its own: stable with every object because the loop is with none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import ParameterError, parameter

PULL_TIME = 0.02
"""Time constant (s) with which a pull, which no object gives, is taken for an error of the models."""

PLAY = 1e-7
"""Half the width (m) of the play behind which the command counts as way, so that noise is none."""

LOOPS = 16
"""So many turns of the command within each other are remembered; in a loop within these no way is trusted."""

CLOSING_TIME = 1.0
"""Time constant (s) of the mean of the reference that tells whether the finger closes."""

STILL = 2e-9
"""A mean of the reference that rises by less than this (m) in `CLOSING_TIME` stands still."""


@dataclass(frozen=True)
class TouchParameters:
    """How far the models of the finger are trusted, and how fast the finger may answer."""

    force_limit: float = parameter(
        5e-3, "the finger pushes with no more than this, whatever is asked for", unit="N",
        low=1e-6, high=10.0,
    )  # fmt: skip
    position_rate: float = parameter(
        200.0, "rate of the loop that follows the reference", unit="1/s", low=1.0, high=1e4
    )
    force_rate: float = parameter(
        100.0, "rate of the loop that holds a force, against a wall", unit="1/s", low=1.0, high=1e4
    )
    filter_time: float = parameter(
        5e-4, "each of the two time constants of the low-pass", unit="s", low=0.0, high=1.0
    )
    model_error: float = parameter(
        0.03, "what the models are off by, as a share of the way", low=0.0, high=0.5
    )
    touch_force: float = parameter(
        5e-5, "below it a push may be drift of the models", unit="N", low=0.0, high=1.0
    )
    zero_time: float = parameter(
        10.0, "time constant with which such drift is learned", unit="s", low=1e-2, high=1e6
    )
    force_margin: float = parameter(
        0.03, "share of the allowed force that is left free, as the told one may be too small by it",
        low=0.0, high=0.5,
    )  # fmt: skip


class TouchCoefficients(NamedTuple):
    """What the step functions need of the parameters; rates are shares per sample."""

    elastic_constant: float  # m/N
    position_rate: float
    force_rate: float
    filter_rate: float
    model_error: float
    touch: float  # m
    zero_rate: float
    pull_rate: float
    closing_rate: float
    aim: float  # share of the allowed force that it pushes with
    opening: float  # m, the most that it opens by
    command_low: float
    command_high: float


class TouchState(NamedTuple):
    """What the step functions remember, changed in place: lists (or float64 arrays)."""

    missing: list[float]  # expected - deflection (m), once and twice low-passed
    behind: list[float]  # reference - deflection (m), once and twice low-passed
    share: list[float]  # m
    drift: list[float]  # m
    clear: list[float]  # `share` and `drift` when nothing pushed last
    way: list[float]  # the command (m) behind a play
    heading: list[float]  # 1 or -1, where the way went last; 0: nowhere yet
    turns: list[float]  # where the way (m) turned, a loop within the other
    shares: list[float]  # `share` at these turns
    depth: list[float]  # number of turns that are remembered
    mean: list[float]  # reference (m), slowly low-passed once and twice
    reference: list[float]  # m, the last one
    command: list[float]  # m, the last one


def touch_coefficients(
    parameters: TouchParameters,
    elastic_constant: float,
    sample_time: float,
    command_low: float,
    command_high: float,
) -> TouchCoefficients:
    """Return the coefficients for a finger's elastic constant (m/N), sample time (s) and limits of the command (m).

    Raises ParameterError for an elastic constant that gives no force.
    """
    p = parameters
    if not elastic_constant > 0.0:
        raise ParameterError(
            f"'dynamics.elastic_constant' is {elastic_constant:g} m/N, must be above 0 where a force is told from "
            "a deflection: `identify stiffness` finds it"
        )
    return TouchCoefficients(
        elastic_constant,
        p.position_rate * sample_time,
        p.force_rate * sample_time,
        sample_time / (p.filter_time + sample_time),
        p.model_error,
        p.touch_force * elastic_constant,
        sample_time / p.zero_time,
        sample_time / (PULL_TIME + sample_time),
        sample_time / (CLOSING_TIME + sample_time),
        1.0 - p.force_margin,
        p.force_rate * sample_time * elastic_constant * p.force_limit,
        command_low,
        command_high,
    )


def touch_rest() -> TouchState:
    """Return the state of a finger that touches nothing, at command 0."""
    return TouchState(
        missing=[0.0, 0.0],
        behind=[0.0, 0.0],
        share=[0.0],
        drift=[0.0],
        clear=[0.0, 0.0],
        way=[0.0],
        heading=[0.0],
        turns=[0.0] * LOOPS,
        shares=[0.0] * LOOPS,
        depth=[0.0],
        mean=[0.0, 0.0],
        reference=[0.0],
        command=[0.0],
    )


# Step functions: plain scalars and indexables, so that numba can compile them as they are.


def touch_start(s: TouchState, command: float, deflection: float, expected: float) -> None:
    """Let a tip that nobody pushes begin at a `command` (m), its reference where it is (m)."""
    s.missing[0] = s.missing[1] = s.drift[0] = s.clear[1] = expected - deflection
    s.share[0] = s.clear[0] = s.heading[0] = s.depth[0] = 0.0
    s.behind[0] = s.behind[1] = 0.0
    s.way[0] = s.command[0] = command
    s.mean[0] = s.mean[1] = s.reference[0] = deflection


def low_pass(state: list[float], rate: float, value: float) -> None:
    """Let `state`, once and twice low-passed, follow `value`."""
    state[0] += rate * (value - state[0])
    state[1] += rate * (state[0] - state[1])


def missing_to(s: TouchState) -> float:
    """Return what is missing (m) beyond what the models are off by."""
    return s.missing[1] - s.share[0] - s.drift[0]


def push_of(c: TouchCoefficients, s: TouchState) -> float:
    """Return the force (N) that pushes the tip back, as estimated; positive against closing."""
    return missing_to(s) / c.elastic_constant


def advance(c: TouchCoefficients, s: TouchState) -> tuple[float, float]:
    """Let the way follow the command; return how much `share` (m) may change for it, and its bound (m)."""
    bound = math.inf
    before = s.way[0]
    way = min(max(before, s.command[0] - PLAY), s.command[0] + PLAY)
    if way == before:
        return 0.0, bound
    heading = 1.0 if way > before else -1.0
    depth = int(s.depth[0])
    if heading * s.heading[0] < 0.0 and depth < LOOPS:
        s.turns[depth] = before
        s.shares[depth] = s.share[0]
        depth += 1
    while depth > 0:
        # The last turn lies behind, but for one that was no longer remembered; the one before it lies ahead.
        ahead = depth - 1 if heading * (s.turns[depth - 1] - before) > 0.0 else depth - 2
        if ahead < 0:
            break
        bound = min(bound, s.shares[ahead] + c.model_error * abs(s.turns[ahead] - way))
        if heading * (s.turns[ahead] - way) > 0.0:
            break
        depth = ahead  # the loop is closed
    s.way[0] = way
    s.heading[0] = heading
    s.depth[0] = depth
    return (c.model_error * abs(way - before) if depth < LOOPS else 0.0), bound


def feel(
    c: TouchCoefficients, s: TouchState, expected: float, deflection: float, max_force: float
) -> None:
    """Take a reading (m) into the estimate of the push, of which `max_force` (N) is allowed.

    `expected` (m) is the deflection of a tip that nobody pushes.
    """
    low_pass(s.missing, c.filter_rate, expected - deflection)
    trust, bound = advance(c, s)
    push = missing_to(s)
    is_felt = push >= min(c.touch, 0.5 * c.elastic_constant * max_force)
    learned = 0.0 if is_felt else min(max(push, -trust), trust)
    s.share[0] = min(s.share[0] + learned, bound)
    if is_felt:
        s.share[0] = min(s.share[0], s.clear[0])
        s.drift[0] = min(s.drift[0], s.clear[1])
    else:
        push = missing_to(s)
        if push <= 0.0:
            s.clear[0] = s.share[0]
            s.clear[1] = s.drift[0]
        if push < 0.0:
            part = s.share if trust > 0.0 else s.drift
            part[0] += c.pull_rate * push
        elif s.mean[0] - s.mean[1] < STILL:
            s.drift[0] += c.zero_rate * push


def press(
    c: TouchCoefficients, s: TouchState, reference: float, deflection: float, max_force: float
) -> float:
    """Return the next command (m): towards the `reference` (m), pushing with `max_force` (N) at most."""
    low_pass(s.behind, c.filter_rate, reference - deflection)
    low_pass(s.mean, c.closing_rate, reference)
    ahead = reference - s.reference[0] + c.position_rate * s.behind[1]
    s.reference[0] = reference
    push = c.force_rate * c.elastic_constant * (c.aim * max_force - push_of(c, s))
    retreat = c.force_rate * max(c.elastic_constant * max_force, c.touch)
    change = max(min(max(ahead, -retreat), push), -c.opening)
    command = min(max(s.command[0] + change, c.command_low), c.command_high)
    s.command[0] = command
    return command


class Touch:
    """The law of one finger at a fixed `sample_time` (s), touching nothing at command 0.

    >>> law = Touch(TouchParameters(), elastic_constant=3.1e-3, sample_time=1e-4, command_low=-22e-6, command_high=22e-6)
    >>> law.step(1e-6, deflection=0.0, expected=0.0, max_force=1e-3) < 1e-6
    True
    """

    def __init__(
        self,
        parameters: TouchParameters,
        elastic_constant: float,
        sample_time: float,
        command_low: float,
        command_high: float,
    ) -> None:
        self.parameters = parameters
        self._coefficients = touch_coefficients(
            parameters, elastic_constant, sample_time, command_low, command_high
        )
        self.reset()

    def reset(self) -> None:
        """Touch nothing, at command 0."""
        self.state = touch_rest()

    def step(self, reference: float, deflection: float, expected: float, max_force: float) -> float:
        """Return the command (m) for one sample; `expected` (m) is the deflection of a tip nobody pushes.

        Of `max_force` (N) and the `force_limit` the smaller one counts. Raises ValueError for an input that is
        not finite or a force below 0; nothing changes.
        """
        inputs = {"reference": reference, "deflection": deflection, "expected": expected}
        for name, value in inputs.items():
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value!r} m, must be finite")
        if not max_force >= 0.0:
            raise ValueError(f"max_force is {max_force!r} N, must be 0 or more")
        c, s = self._coefficients, self.state
        limit = min(max_force, self.parameters.force_limit)
        feel(c, s, expected, deflection, limit)
        return press(c, s, reference, deflection, limit)

    @property
    def push(self) -> float:
        """Force (N) that pushes the tip back, as estimated."""
        return push_of(self._coefficients, self.state)
