# SPDX-License-Identifier: Apache-2.0
"""Prandtl-Ishlinskii hysteresis of a piezo actuator and its exact analytic inverse.

The operator is a weighted sum of plays, seen through memoryless one-sided dead zones::

    z_i <- min(u + r_i, max(u - r_i, z_i)),   0 = r_0 < r_1 < ... < r_n         (plays)
    x   =  sum_i w_i z_i                                                        (hysteresis H)
    y   =  x + sum_j p_j max(x - a_j, 0) + sum_j q_j min(x + b_j, 0)            (dead zones S)

with the voltage u and the deflection y. Without dead zones y = x is the classical operator, with
them the modified one for asymmetric actuators. With a rate coefficient b the thresholds r_1 ... r_n
grow by b |du/dt|, the rate being that of the last voltage step.

The inverse has the same form, so one set of step functions serves both. With the partial sums
W_i = w_0 + ... + w_i::

    r'_i = sum_{j<=i} w_j (r_i - r_j),  w'_0 = 1/w_0,  w'_i = -w_i / (W_i W_{i-1})
    z'_i = W_i z_i + sum_{j>i} w_j z_j

It exists if and only if every W_i > 0 (and likewise on each side of the dead zones). A common
growth b |du/dt| of r_1 ... r_n leaves the order in which plays move untouched, so the inverse stays
exact with r'_i growing by w_0 b |du/dt|; this needs gaps r_{i+1} - r_i that never shrink for i >= 1.
It is stable, too, while b/T |1 - w_0/W_i| < 1 at the sample time T.
The states must belong to a history: abs(z_{i+1} - z_i) <= r_{i+1} - r_i.

With all plays at 0 the first rise from rest is half a loop (Masing's rule), whatever the weights are. A
virgin share v bends it and leaves every loop as it is: of each weight w_i, i >= 1, the part 1 - v has its
play at 0 and v/2 each at r_i and -r_i, which join at 2 r_i and at once. The first fall is the same curve
downward. Once the voltage has been to both ends all three are one play again, and nothing is left of it.
The parts are no history of one another, so the analytic inverse begins at 0; :func:`operator_inverse`
takes any states.

Sources: H. Janocha, K. Kuhnen, Sensors and Actuators A 79 (2000) 83 (inverse); K. Kuhnen, European
Journal of Control 9 (2003) 407 (modified); M. Al Janaideh, P. Krejci, IEEE/ASME Transactions on
Mechatronics 18 (2013) 1498 (rate-dependent thresholds).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from piezo_control.parameters import ParameterError, parameter
from piezo_control.safety import VoltageParameters
from piezo_control.sequence import SAMPLE_TIME


@dataclass(frozen=True)
class HysteresisParameters:
    """Thresholds and weights of the operator; empty dead zones mean the classical one.

    The defaults give +-22 um at +-40 V and a loop as wide as 18 % of the deflection span
    (M. Rakotondrabe et al., IFAC 2008, Fig. 5).

    Raises
    ------
    ParameterError
        If the lengths differ, thresholds do not increase, or a partial sum of weights is not
        positive (no inverse exists); the message names the first offending index.
    """

    thresholds: tuple[float, ...] = parameter(
        (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.0, 21.0, 24.0, 27.0, 30.0, 33.0),
        "play thresholds r_i; the first is 0 (the linear part)",
        unit="V",
        low=0.0,
    )
    weights: tuple[float, ...] = parameter(
        (300e-9, 71e-9, 60e-9, 50e-9, 41e-9, 34e-9, 28e-9, 23e-9, 19e-9, 17e-9, 13e-9, 11e-9),
        "play weights w_i; every partial sum positive",
        unit="m/V",
    )
    upper_thresholds: tuple[float, ...] = parameter(
        (), "dead zones above: deflections a_j beyond which the slope changes", unit="m", low=0.0
    )
    upper_weights: tuple[float, ...] = parameter(
        (), "dead zones above: slope changes p_j; 1 + every partial sum positive"
    )
    lower_thresholds: tuple[float, ...] = parameter(
        (), "dead zones below: deflections -b_j beyond which the slope changes", unit="m", low=0.0
    )
    lower_weights: tuple[float, ...] = parameter(
        (), "dead zones below: slope changes q_j; 1 + every partial sum positive"
    )
    rate_coefficient: float = parameter(
        0.0, "growth b of the thresholds r_1 ... r_n with abs(du/dt)", unit="s", low=0.0
    )
    virgin_share: float = parameter(
        0.0,
        "part of w_1 ... w_n whose plays rest at both r_i and -r_i before the first rise; 0: all at 0",
        low=0.0,
        high=1.0,
    )

    def __post_init__(self) -> None:
        if not self.thresholds or self.thresholds[0] != 0.0:
            raise ParameterError(f"'thresholds' is {self.thresholds!r}, must start with 0.0 V")
        for side, first in (("", 0.0), ("upper_", 1.0), ("lower_", 1.0)):
            self._check_side(f"{side}thresholds", f"{side}weights", first)

    def _check_side(self, thresholds_name: str, weights_name: str, first: float) -> None:
        thresholds, weights = getattr(self, thresholds_name), getattr(self, weights_name)
        if len(weights) != len(thresholds):
            raise ParameterError(
                f"'{weights_name}' has {len(weights)} values, must have as many as "
                f"'{thresholds_name}': {len(thresholds)}"
            )
        for i in range(1, len(thresholds)):
            if not thresholds[i] > thresholds[i - 1]:
                raise ParameterError(
                    f"'{thresholds_name}[{i}]' is {thresholds[i]!r}, must be greater than "
                    f"'{thresholds_name}[{i - 1}]' = {thresholds[i - 1]!r}"
                )
        slope = first
        for i, weight in enumerate(weights):
            slope += weight
            if not slope > 0.0:
                raise ParameterError(
                    f"'{weights_name}[{i}]' is {weight!r}: the slope {slope:g} up to and with "
                    f"index {i} must be positive, else no inverse exists"
                )


class Coefficients(NamedTuple):
    """What the step functions need of an operator or an inverse: lists (or float64 arrays)."""

    thresholds: Sequence[float]
    weights: Sequence[float]
    dilation: float  # growth of thresholds[1:] per volt of the last voltage step
    upper_thresholds: Sequence[float]
    upper_weights: Sequence[float]
    lower_thresholds: Sequence[float]
    lower_weights: Sequence[float]
    rest: Sequence[float]  # plays of an actuator that has not moved yet


class State(NamedTuple):
    """What the step functions remember, changed in place: lists (or float64 arrays).

    A single number that changes is a list of one: that is what plain Python and compiled code can both
    change in place.
    """

    plays: list[float]  # z_i of the operator (V) or z'_i of the inverse (m)
    voltage: list[float]  # the last voltage (V)
    voltage_step: list[float]  # size of the last voltage step (V)


def coefficients(parameters: HysteresisParameters, sample_time: float) -> Coefficients:
    """Return the operator's coefficients; `sample_time` (s) turns rates into voltage steps."""
    return Coefficients(
        list(parameters.thresholds),
        list(parameters.weights),
        parameters.rate_coefficient / sample_time,
        list(parameters.upper_thresholds),
        list(parameters.upper_weights),
        list(parameters.lower_thresholds),
        list(parameters.lower_weights),
        [0.0] * len(parameters.weights),
    )


def from_rest(parameters: HysteresisParameters, sample_time: float) -> Coefficients:
    """Return the operator with the virgin share's plays as plays of their own; otherwise as :func:`coefficients`."""
    c = coefficients(parameters, sample_time)
    share = parameters.virgin_share
    if share == 0.0:
        return c
    parts = ((1.0 - share, 0.0), (0.5 * share, 1.0), (0.5 * share, -1.0))
    return c._replace(
        thresholds=[0.0, *(r for r in c.thresholds[1:] for _ in parts)],
        weights=[c.weights[0], *(part * w for w in c.weights[1:] for part, _ in parts)],
        rest=[0.0, *(place * r for r in c.thresholds[1:] for _, place in parts)],
    )


def at_rest(operator: Coefficients) -> State:
    """Return the state at 0 V of an actuator that has not moved yet."""
    return State(list(operator.rest), voltage=[0.0], voltage_step=[0.0])


def invert(operator: Coefficients) -> Coefficients:
    """Return the coefficients of the analytic inverse (thresholds r'_i in m, weights w'_i in V/m).

    Raises
    ------
    ParameterError
        If the thresholds depend so much on the rate that errors would grow from sample to sample:
        each volt of the last step moves the next voltage by up to b/T abs(1 - w_0/W_i), T being the
        sample time, which must stay below 1.
    """
    first = operator.weights[0]
    feedback = max(abs(1.0 - first / slope) for slope in accumulate(operator.weights))
    if not operator.dilation * feedback < 1.0:
        raise ParameterError(
            f"'rate_coefficient' is {operator.dilation:g} sample times, must be below "
            f"{1.0 / feedback:g}: the inverse would be unstable"
        )
    thresholds, weights = _invert_side(first, operator.thresholds[1:], operator.weights[1:])
    return Coefficients(
        [0.0, *thresholds],
        [1.0 / first, *weights],
        first * operator.dilation,
        *_invert_side(1.0, operator.upper_thresholds, operator.upper_weights),
        *_invert_side(1.0, operator.lower_thresholds, operator.lower_weights),
        [0.0] * len(operator.weights),
    )


def _invert_side(
    slope: float, thresholds: Sequence[float], weights: Sequence[float]
) -> tuple[list[float], list[float]]:
    """Follow the recursion outward from the `slope` in the middle, over plays or dead zones."""
    inverse_thresholds, inverse_weights = [], []
    position, reached = 0.0, 0.0
    for threshold, weight in zip(thresholds, weights, strict=True):
        reached += slope * (threshold - position)
        position = threshold
        inverse_thresholds.append(reached)
        inverse_weights.append(-weight / (slope * (slope + weight)))
        slope += weight
    return inverse_thresholds, inverse_weights


# Step functions: plain scalars and indexables, so that numba can compile them as they are.


def plays_output(c: Coefficients, s: State, value: float) -> float:
    """Return sum w_i z_i for the next input `value`, leaving the plays where they are."""
    thresholds, weights, plays = c.thresholds, c.weights, s.plays
    growth = c.dilation * s.voltage_step[0]
    total = weights[0] * value
    for i in range(1, len(weights)):
        threshold = thresholds[i] + growth
        play = plays[i]
        if play < value - threshold:
            play = value - threshold
        elif play > value + threshold:
            play = value + threshold
        total += weights[i] * play
    return total


def plays_move(c: Coefficients, s: State, value: float) -> float:
    """Move the plays to the input `value` and return sum w_i z_i."""
    thresholds, weights, plays = c.thresholds, c.weights, s.plays
    growth = c.dilation * s.voltage_step[0]
    plays[0] = value
    total = weights[0] * value
    for i in range(1, len(weights)):
        threshold = thresholds[i] + growth
        play = plays[i]
        if play < value - threshold:
            play = value - threshold
            plays[i] = play
        elif play > value + threshold:
            play = value + threshold
            plays[i] = play
        total += weights[i] * play
    return total


def map_plays(c: Coefficients, s: State) -> None:
    """Turn plays of `c` into those of its inverse: z'_i = W_i z_i + sum_{j>i} w_j z_j.

    With the coefficients of the inverse it leads back to the operator's plays.
    """
    slope = 0.0
    for i in range(len(c.weights)):
        slope += c.weights[i]
    outer = 0.0
    for i in range(len(c.weights) - 1, -1, -1):
        play = s.plays[i]
        s.plays[i] = slope * play + outer
        outer += c.weights[i] * play
        slope -= c.weights[i]


def dead_zones(c: Coefficients, value: float) -> float:
    """Return value + sum p_j max(value - a_j, 0) + sum q_j min(value + b_j, 0)."""
    total = value
    for j in range(len(c.upper_weights)):
        total += c.upper_weights[j] * max(value - c.upper_thresholds[j], 0.0)
    for j in range(len(c.lower_weights)):
        total += c.lower_weights[j] * min(value + c.lower_thresholds[j], 0.0)
    return total


def remember_voltage(s: State, voltage: float) -> None:
    """Take note of the voltage applied; the next sample's thresholds follow its step."""
    s.voltage_step[0] = abs(voltage - s.voltage[0])
    s.voltage[0] = voltage


def operator_step(operator: Coefficients, s: State, voltage: float) -> float:
    """Apply `voltage` (V) to the operator and return the deflection (m)."""
    hysteresis = plays_move(operator, s, voltage)
    remember_voltage(s, voltage)
    return dead_zones(operator, hysteresis)


def operator_inverse(
    operator: Coefficients, s: State, value: float, scale: float, line: float
) -> float:
    """Return the voltage u (V) at which scale H(u) + line u is `value` (m); nothing moves yet.

    Solved on the operator's own plays, so that `scale` and `line` (m/V) may change from sample to sample
    where the inverse's plays would have to be mapped. From the last voltage on, each play adds its weight to
    the slope where it joins; in which order, the states say. Every slope scale W_i + line must be positive;
    for the classical operator with constant thresholds.
    """
    thresholds, weights, plays = operator.thresholds, operator.weights, s.plays
    voltage = s.voltage[0]
    reached = line * voltage
    for i in range(len(weights)):
        reached += scale * weights[i] * plays[i]
    direction = 1.0 if value >= reached else -1.0
    while True:
        slope = scale * weights[0] + line
        ahead = math.inf
        following = voltage
        for i in range(1, len(weights)):
            joins = plays[i] + direction * thresholds[i]
            distance = direction * (joins - voltage)
            if distance <= 0.0:
                slope += scale * weights[i]
            elif distance < ahead:
                ahead = distance
                following = joins
        if not direction * (value - reached) > slope * ahead:
            return voltage + (value - reached) / slope
        reached += slope * (following - voltage)
        voltage = following


def inverse_voltage(inverse: Coefficients, s: State, deflection: float) -> float:
    """Return the voltage (V) that leads the actuator to `deflection` (m); nothing moves yet."""
    return plays_output(inverse, s, dead_zones(inverse, deflection))


def inverse_move(inverse: Coefficients, s: State, deflection: float, voltage: float) -> None:
    """Move the inverse to `deflection` (m), reached by applying exactly its `voltage` (V)."""
    plays_move(inverse, s, dead_zones(inverse, deflection))
    remember_voltage(s, voltage)


def inverse_follow(operator: Coefficients, inverse: Coefficients, s: State, voltage: float) -> None:
    """Move the inverse to where the actuator goes under any other `voltage` (V).

    Used for a clipped voltage, a ramp to 0 V or a homing sweep: the plays are mapped to the
    actuator's, moved there, and mapped back.
    """
    map_plays(inverse, s)
    plays_move(operator, s, voltage)
    map_plays(operator, s)
    remember_voltage(s, voltage)


def reachable_range(operator: Coefficients, low: float, high: float) -> tuple[float, float]:
    """Return the deflections (m) that are reached between `low` and `high` (V), whatever came before.

    That is the ends of the loop over the whole range. An actuator that is driven to one side only does not come
    back to where it was homed; one whose range is the same on both sides arrives at the same ends from there.
    Beyond them the inverse would go on at the outermost slope 1/W_n, unsupported by any data.
    """
    state = at_rest(operator)

    def arrive(voltage: float) -> float:
        operator_step(operator, state, voltage)
        # Once more: at rest, thresholds that depend on the rate are the plain ones.
        return operator_step(operator, state, voltage)

    for voltage in (low, high):
        arrive(voltage)
    return arrive(low), arrive(high)


REACH = reachable_range(
    coefficients(HysteresisParameters(), SAMPLE_TIME),
    VoltageParameters.voltage_low,
    VoltageParameters.voltage_high,
)
"""Of the paper's finger (m)."""


def check_plays(thresholds: Sequence[float], plays: Sequence[float]) -> None:
    """Raise ParameterError, naming the index, unless some history leads to these plays (V)."""
    if len(plays) != len(thresholds):
        raise ParameterError(f"{len(plays)} plays given, must be {len(thresholds)}")
    for i in range(1, len(plays)):
        gap = thresholds[i] - thresholds[i - 1]
        if not abs(plays[i] - plays[i - 1]) <= gap * (1.0 + 1e-9):
            raise ParameterError(
                f"plays[{i}] is {plays[i]!r}, must be within {gap:g} V of plays[{i - 1}] = "
                f"{plays[i - 1]!r}: no history leads there"
            )


class Hysteresis:
    """Operator of one actuator; `step` takes one voltage, a call takes a history of them.

    Parameters
    ----------
    parameters : HysteresisParameters
    sample_time : float
        Time between steps (s); only rate-dependent thresholds depend on it.
    plays : sequence of float, optional
        Initial states z_i (V), which must belong to some history; a homed actuator's are all 0.

    Raises
    ------
    ParameterError
        If `plays` has a wrong length or cannot be reached by any history; it names the index.

    Examples
    --------
    >>> actuator = Hysteresis(HysteresisParameters())
    >>> inverse = actuator.inverse()
    >>> round(actuator.step(inverse.step(7e-6)), 12)
    7e-06
    """

    def __init__(
        self,
        parameters: HysteresisParameters,
        sample_time: float = 1.0,
        plays: Sequence[float] | None = None,
    ) -> None:
        self.coefficients = coefficients(parameters, sample_time)
        if plays is None:
            plays = [0.0] * len(parameters.thresholds)
        check_plays(parameters.thresholds, plays)
        self.state = State(list(plays), [plays[0]], [0.0])

    def step(self, voltage: float) -> float:
        """Apply one `voltage` (V) and return the deflection (m)."""
        return operator_step(self.coefficients, self.state, voltage)

    def __call__(self, voltage: ArrayLike) -> NDArray[np.float64]:
        """Apply a history of voltages (V, 1-D) and return the deflections (m), of equal shape."""
        return np.array([self.step(v) for v in np.asarray(voltage, float).tolist()])

    def inverse(self) -> InverseHysteresis:
        """Return the inverse that compensates this actuator from its present state on."""
        return InverseHysteresis(self.coefficients, copy.deepcopy(self.state))


class InverseHysteresis:
    """Analytic inverse of an actuator with the coefficients `operator`, in the state `actuator`."""

    def __init__(self, operator: Coefficients, actuator: State) -> None:
        self.operator = operator
        self.coefficients = invert(operator)
        map_plays(operator, actuator)
        self.state = actuator

    def step(self, deflection: float) -> float:
        """Return the voltage (V) that leads the actuator to `deflection` (m)."""
        voltage = inverse_voltage(self.coefficients, self.state, deflection)
        inverse_move(self.coefficients, self.state, deflection, voltage)
        return voltage

    def __call__(self, deflection: ArrayLike) -> NDArray[np.float64]:
        """Return the voltages (V) for a history of deflections (m, 1-D), of equal shape."""
        return np.array([self.step(d) for d in np.asarray(deflection, float).tolist()])

    def follow(self, voltage: float) -> None:
        """Take note of a `voltage` (V) that was applied instead of one of `step`."""
        inverse_follow(self.operator, self.coefficients, self.state, voltage)

    def actuator_plays(self) -> list[float]:
        """Return the states z_i (V) of the actuator this inverse belongs to."""
        actuator = copy.deepcopy(self.state)
        map_plays(self.coefficients, actuator)
        return actuator.plays


def _dead_zones_of(c: Coefficients, value: NDArray) -> NDArray:
    """Array form of :func:`dead_zones`, of a 1-D `value`."""
    above = np.maximum(value[:, None] - c.upper_thresholds, 0.0)
    below = np.minimum(value[:, None] + c.lower_thresholds, 0.0)
    bent = np.sum(c.upper_weights * above, axis=1) + np.sum(c.lower_weights * below, axis=1)
    return value + bent


def play_history(
    thresholds: ArrayLike, voltage: ArrayLike, plays: ArrayLike | None = None
) -> NDArray[np.float64]:
    """Return the states of plays under a voltage history, as regressors of an identification.

    Parameters
    ----------
    thresholds : 1-D array with shape (plays,), or (samples, plays) where they change (V)
    voltage : 1-D array with shape (samples,) (V)
    plays : 1-D array with shape (plays,), optional
        States before the first sample (V), default 0.

    Returns
    -------
    2-D array with shape (samples, plays) (V)
    """
    voltage = np.asarray(voltage, float)[:, None]
    history = voltage - thresholds
    upper = voltage + thresholds
    state = np.zeros(history.shape[1]) if plays is None else np.asarray(plays, float)
    for sample in range(len(history)):
        np.maximum(history[sample], state, out=history[sample])
        np.minimum(history[sample], upper[sample], out=history[sample])
        state = history[sample]
    return history


def deflection_history(
    parameters: HysteresisParameters, voltage: ArrayLike, sample_time: float = 1.0
) -> NDArray[np.float64]:
    """Return the deflections (m) of an actuator under a long voltage history (V, 1-D) from rest.

    Without a virgin share the same as ``Hysteresis(parameters, sample_time)(voltage)``, computed play by play at once.
    """
    c = from_rest(parameters, sample_time)
    c = Coefficients(*(np.array(entry) for entry in c))
    voltage = np.asarray(voltage, float)
    thresholds = c.thresholds
    if c.dilation:
        voltage_step = np.abs(np.diff(voltage, prepend=0.0))
        growth = c.dilation * np.concatenate(([0.0], voltage_step[:-1]))
        thresholds = thresholds + growth[:, None] * (np.arange(len(thresholds)) > 0)
    return _dead_zones_of(c, play_history(thresholds, voltage, c.rest) @ c.weights)
