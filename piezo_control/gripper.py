# SPDX-License-Identifier: Apache-2.0
"""Two fingers as one gripper: from a wanted opening to two references, and when the motion is over.

    opening = rest_opening - (deflection_left + deflection_right)

Positive deflections close. Each finger's reference goes from where it is to (rest_opening - opening) / 2
on a straight line, at half the speed wanted of the opening. Lines are profiles in the finger's own time,
its sample number times the sample time: running free that is the wall clock, in lock-step the simulated
one, which passes at whatever speed the machine manages. So the speed holds in both, to the sample, and no
message has to be in time.

The force is the larger of the two pushes that bend the tips open, -tip_force. It ends closing motions;
opening relieves it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import ParameterError, parameter
from piezo_control.profile import Profile

SMALLEST = 1e-9
"""Slowest speed (m/s) and least force (N) of a goal: less is a mistake, no motion."""


@dataclass(frozen=True)
class GripperParameters:
    """Geometry and limits of a gripper of two fingers."""

    sample_time: float = parameter(1e-4, "sample time of the fingers", unit="s", low=1e-7, high=1.0)
    rest_opening: float = parameter(
        40e-6, "opening with both fingers at deflection 0", unit="m", low=0.0, high=1e-2
    )
    deflection_low: float = parameter(
        -20e-6, "lowest reference given to a finger", unit="m", low=-1e-3, high=0.0
    )
    deflection_high: float = parameter(
        20e-6, "highest reference given to a finger", unit="m", low=0.0, high=1e-3
    )
    speed: float = parameter(
        20e-6, "speed of the opening where a goal names none", unit="m/s", low=1e-9, high=1.0
    )
    speed_limit: float = parameter(
        1e-3, "highest speed a goal may ask for", unit="m/s", low=1e-9, high=1.0
    )
    force_limit: float = parameter(
        5e-3, "highest force a goal may ask for, and the limit where it names none", unit="N",
        low=1e-6, high=10.0,
    )  # fmt: skip
    tolerance: float = parameter(
        2e-7, "the opening is reached when it is so near", unit="m", low=1e-9, high=1e-4
    )
    settling_time: float = parameter(
        0.5, "time the fingers have to come within tolerance after the ramp", unit="s", low=0.0,
        high=60.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        if self.speed > self.speed_limit:
            raise ParameterError(
                f"'speed' is {self.speed} m/s, must be at most 'speed_limit' {self.speed_limit} m/s"
            )
        if self.rest_opening < 2.0 * self.deflection_high:
            raise ParameterError(
                f"'deflection_high' is {self.deflection_high} m: the tips would cross; "
                f"must be in [0, {self.rest_opening / 2:g}] m, half of 'rest_opening'"
            )


class Goal(NamedTuple):
    """What is wanted: opening (m), the force that ends a closing motion (N), speed of the opening (m/s)."""

    opening: float
    max_force: float
    speed: float


class Outcome(NamedTuple):
    """How a motion ended."""

    success: bool
    reached_goal: bool
    stalled: bool
    text: str


def check_goal(
    parameters: GripperParameters, opening: float, max_force: float, speed: float
) -> Goal:
    """Return the goal with the defaults for force and speed in place of 0.

    Raises ValueError naming value and allowed range.
    """
    p = parameters
    goal = Goal(opening, max_force or p.force_limit, speed or p.speed)
    # rounded to the picometre, so that a bound that somebody types is inside
    narrowest = round(p.rest_opening - 2.0 * p.deflection_high, 12)
    widest = round(p.rest_opening - 2.0 * p.deflection_low, 12)
    for name, low, high, unit in (
        ("opening", narrowest, widest, "m"),
        ("max_force", SMALLEST, p.force_limit, "N"),
        ("speed", SMALLEST, p.speed_limit, "m/s"),
    ):
        value = getattr(goal, name)
        if not low <= value <= high:
            raise ValueError(f"{name} is {value:g}, must be in [{low:g}, {high:g}] {unit}")
    return goal


def opening_of(parameters: GripperParameters, deflections: Sequence[float]) -> float:
    """Return the opening (m) between tips with these deflections (m)."""
    return parameters.rest_opening - sum(deflections)


def force_of(tip_forces: Sequence[float]) -> float:
    """Return the larger push (N, >= 0) on tips with these tip forces (N, negative opens)."""
    return max(0.0, *(-force for force in tip_forces))


def hold(reference: float) -> Profile:
    """Return the profile that stays at `reference` (m)."""
    return Profile([0.0], [reference])


class Motion:
    """One goal on its way.

    Parameters
    ----------
    references : sequence of two floats
        Where the fingers' references are at the start (m).
    """

    def __init__(
        self, parameters: GripperParameters, goal: Goal, references: Sequence[float]
    ) -> None:
        self.goal = goal
        self._parameters = parameters
        self._target = (parameters.rest_opening - goal.opening) / 2.0
        self._closing = self._target > min(references)
        self._arrivals = [math.inf] * len(references)

    def departed(self, finger: int) -> bool:
        """Tell whether `depart` was called for this finger."""
        return math.isfinite(self._arrivals[finger])

    def depart(self, finger: int, time: float, reference: float) -> Profile:
        """Return the line for a finger whose reference is `reference` (m) at its time `time` (s)."""
        duration = abs(self._target - reference) / (self.goal.speed / 2.0)
        self._arrivals[finger] = time + duration
        if self._arrivals[finger] == time:
            return hold(self._target)
        return Profile([time, time + duration], [reference, self._target], linear=True)

    def decide(
        self, times: Sequence[float], deflections: Sequence[float], tip_forces: Sequence[float]
    ) -> Outcome | None:
        """Return how the motion ended, or None while it goes on; every finger in its own time (s)."""
        p = self._parameters
        force = force_of(tip_forces)
        error = opening_of(p, deflections) - self.goal.opening
        reached = abs(error) <= p.tolerance
        if self._closing and force >= self.goal.max_force:
            text = f"stopped by {force:g} N, limit {self.goal.max_force:g} N"
            return Outcome(True, reached, True, text)
        beyond = min(time - arrival for time, arrival in zip(times, self._arrivals))
        if beyond >= 0.0 and reached:
            return Outcome(True, True, False, "reached")
        if beyond > p.settling_time:
            text = (
                f"{error * 1e6:+.2f} µm from the opening {p.settling_time:g} s after the ramp, "
                f"tolerance {p.tolerance * 1e6:g} µm, force {force:g} N"
            )
            return Outcome(False, False, True, text)
        return None
