# SPDX-License-Identifier: Apache-2.0
"""Two fingers as one gripper: from a wanted opening to two references, and when the motion is over.

    opening = rest_opening - (deflection_left + deflection_right)

Positive deflections close. Each finger's reference goes from where it is to (rest_opening - opening) / 2
on a straight line, at half the speed wanted of the opening. Lines are profiles in the finger's own time,
its sample number times the sample time: running free that is the wall clock, in lock-step the simulated
one, which passes at whatever speed the machine manages. So the speed holds in both, to the sample, and no
message has to be in time. A trajectory of openings is the same with more than one line.

The force is the larger of the two pushes of the object, as the fingers' loops tell them. These loops stop at
`max_force` and hold it by themselves, within milliseconds; what is decided here is when that is so and both
fingers rest. The references then stay `HOLD_BEYOND` ahead of the tips, so that it is the force that is held,
not the place, and a finger whose object is gone goes no further than that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count
from typing import NamedTuple

import numpy as np

from piezo_control.parameters import ParameterError, parameter
from piezo_control.profile import Profile
from piezo_control.sequence import SAMPLE_TIME
from piezo_control.touch import TouchParameters

SMALLEST = 1e-9
"""Slowest speed (m/s) of a goal: less is a mistake, no motion."""

ROUNDING = 1e-9
"""An opening that is no further (m) beyond an end of the reach is that end, rounded by who wrote it down."""

HOLD_BEYOND = 1e-6
"""How far (m) a reference stays ahead of a tip that holds a force."""

AT_LIMIT = 0.9
"""Share of the force limit from which on a finger has stalled; what pushes with more than the limit over it still eases."""

REST_TIME = 0.05
"""A finger rests when it has stayed in place for so long (s); one that stalls, for as long as its line has to move it."""


@dataclass(frozen=True)
class GripperParameters:
    """Geometry and limits of a gripper of two fingers."""

    sample_time: float = parameter(
        SAMPLE_TIME, "sample time of the fingers", unit="s", low=1e-7, high=1.0
    )
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
    touch_force: float = parameter(
        TouchParameters.touch_force,
        "least force a goal may ask for: what fingers feel below may be drift of their models", unit="N",
        low=1e-9, high=1.0,
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


class Waypoint(NamedTuple):
    """An opening (m) and its time (s) after the departure."""

    time: float
    opening: float


class Goal(NamedTuple):
    """What is wanted: opening (m), the force that ends a closing motion (N), speed of the opening (m/s).

    With waypoints these make the speed, and `opening` is that of the last one.
    """

    opening: float
    max_force: float
    speed: float
    waypoints: tuple[Waypoint, ...] = ()


class Outcome(NamedTuple):
    """How a motion ended."""

    success: bool
    reached_goal: bool
    stalled: bool
    text: str


def reach(parameters: GripperParameters) -> tuple[float, float]:
    """Return the narrowest and the widest opening (m)."""
    p = parameters
    # rounded to the picometre, so that a bound that somebody types is inside
    narrowest = round(p.rest_opening - 2.0 * p.deflection_high, 12)
    return narrowest, round(p.rest_opening - 2.0 * p.deflection_low, 12)


def within_reach(parameters: GripperParameters, opening: float) -> float:
    """Return an opening (m), moved to the end of the reach where that is a matter of rounding."""
    narrowest, widest = reach(parameters)
    nearest = min(max(opening, narrowest), widest)
    return nearest if abs(opening - nearest) <= ROUNDING else opening


def check_goal(
    parameters: GripperParameters, opening: float, max_force: float, speed: float
) -> Goal:
    """Return the goal with the defaults for force and speed in place of 0.

    Raises ValueError naming value and allowed range.
    """
    p = parameters
    opening = within_reach(p, opening)
    goal = Goal(opening, max_force or p.force_limit, speed or p.speed)
    narrowest, widest = reach(p)
    for name, low, high, unit in (
        ("opening", narrowest, widest, "m"),
        ("max_force", p.touch_force, p.force_limit, "N"),
        ("speed", SMALLEST, p.speed_limit, "m/s"),
    ):
        value = getattr(goal, name)
        if not low <= value <= high:
            raise ValueError(f"{name} is {value:g}, must be in [{low:g}, {high:g}] {unit}")
    return goal


def check_trajectory(
    parameters: GripperParameters, waypoints: Sequence[Waypoint], opening: float
) -> Goal:
    """Return the goal that follows `waypoints` from `opening` (m), with the force limit.

    Raises ValueError naming the waypoint, its value and the allowed range.
    """
    p = parameters
    narrowest, widest = reach(p)
    before = Waypoint(0.0, opening)
    waypoints = [Waypoint(w.time, within_reach(p, w.opening)) for w in waypoints]
    for number, waypoint in enumerate(waypoints):
        if not narrowest <= waypoint.opening <= widest:
            raise ValueError(
                f"waypoint {number}: opening is {waypoint.opening:g}, must be in "
                f"[{narrowest:g}, {widest:g}] m"
            )
        way, duration = abs(waypoint.opening - before.opening), waypoint.time - before.time
        if waypoint.time == 0.0 and number == 0 and way <= p.tolerance:
            continue  # it says where the gripper is
        if not duration >= p.sample_time:
            raise ValueError(
                f"waypoint {number} is at {waypoint.time:g} s, must be {p.sample_time:g} s or more "
                f"after {before.time:g} s"
            )
        if way > p.speed_limit * duration:
            raise ValueError(
                f"waypoint {number}: speed is {way / duration:g}, must be at most {p.speed_limit:g} m/s"
            )
        before = waypoint
    if before.time == 0.0:
        raise ValueError("the trajectory has no waypoint after its start")
    way_ahead = tuple(waypoint for waypoint in waypoints if waypoint.time > 0.0)
    return Goal(before.opening, p.force_limit, p.speed_limit, way_ahead)


def opening_of(parameters: GripperParameters, deflections: Sequence[float]) -> float:
    """Return the opening (m) between tips with these deflections (m)."""
    return parameters.rest_opening - sum(deflections)


def force_of(pushes: Sequence[float]) -> float:
    """Return the larger of the object's pushes (N, >= 0) on the tips; NaN when one is not known."""
    return math.nan if any(map(math.isnan, pushes)) else max(0.0, *pushes)


def hold(reference: float) -> Profile:
    """Return the profile that stays at `reference` (m)."""
    return Profile([0.0], [reference])


class Motion:
    """One goal on its way.

    Parameters
    ----------
    deflections : sequence of two floats
        Where the tips are at the start (m). It closes if one of them is to go on by more than is no way at all; a
        reference that is ahead of its tip, to hold a force, is no place that was reached.
    """

    def __init__(
        self, parameters: GripperParameters, goal: Goal, deflections: Sequence[float]
    ) -> None:
        self.goal = goal
        self._parameters = parameters
        openings = [waypoint.opening for waypoint in goal.waypoints] or [goal.opening]
        way = max(map(self._reference, openings)) - min(deflections)
        self.closing = way > parameters.tolerance / 2.0
        self._arrivals = [math.inf] * len(deflections)
        self._stall_times = [REST_TIME] * len(deflections)
        nowhere = (math.inf, math.nan)  # since when (s) a tip is where (m)
        self._places = [nowhere] * len(deflections)
        self._overdue = math.inf  # s after the ramp, when the settling time was first seen over

    def departed(self, finger: int) -> bool:
        """Tell whether `depart` was called for this finger."""
        return math.isfinite(self._arrivals[finger])

    def depart(self, finger: int, time: float, reference: float) -> Profile:
        """Return the lines for a finger whose reference is `reference` (m) at its time `time` (s)."""
        target = self._reference(self.goal.opening)
        straight = Waypoint(abs(target - reference) / (self.goal.speed / 2.0), self.goal.opening)
        way = self.goal.waypoints or (straight,)
        self._arrivals[finger] = time + way[-1].time
        if self._arrivals[finger] == time:
            return hold(target)
        instants = [time, *(time + waypoint.time for waypoint in way)]
        values = [reference, *(self._reference(waypoint.opening) for waypoint in way)]
        line = Profile(instants, values, linear=True)
        speeds = np.abs(np.diff(line.value) / np.diff(line.time))
        slowest = np.min(speeds, where=speeds > 0.0, initial=self._parameters.speed_limit)
        # On its line a tip stays in place, within half a tolerance, for half of this time.
        self._stall_times[finger] = max(REST_TIME, self._parameters.tolerance / slowest)
        return line

    def _reference(self, opening: float) -> float:
        """Return the reference (m) of either finger at an opening (m)."""
        return (self._parameters.rest_opening - opening) / 2.0

    def rests(self, finger: int, time: float, deflection: float) -> float:
        """Take note of where a tip is (m) at its time (s); return for how long (s) it has been there."""
        since, place = self._places[finger]
        if not abs(deflection - place) <= self._parameters.tolerance / 2.0:
            since = time
            self._places[finger] = time, deflection
        return time - since

    def decide(
        self, times: Sequence[float], deflections: Sequence[float], pushes: Sequence[float]
    ) -> Outcome | None:
        """Return how the motion ended, or None while it goes on.

        Every finger in its own time (s); `pushes` (N) are NaN where a finger does not feel any.
        """
        p = self._parameters
        force = force_of(pushes)
        error = opening_of(p, deflections) - self.goal.opening
        reached = abs(error) <= p.tolerance
        still = [self.rests(*finger) for finger in zip(count(), times, deflections)]
        stands = all(time >= enough for time, enough in zip(still, self._stall_times))
        over = [time - arrival for time, arrival in zip(times, self._arrivals)]
        stalled = [push >= AT_LIMIT * self.goal.max_force for push in pushes]
        eased = not any(push > self.goal.max_force / AT_LIMIT for push in pushes)
        if self.closing and any(stalled) and stands and eased:
            # A finger that touches nothing goes on to the end of its line.
            if all(at_limit or late >= 0.0 for at_limit, late in zip(stalled, over)):
                text = f"stopped by {force:g} N, limit {self.goal.max_force:g} N"
                return Outcome(True, reached, True, text)
        beyond = min(over)
        if beyond >= 0.0 and reached and min(still) >= REST_TIME:
            return Outcome(True, True, False, "reached")
        if beyond > p.settling_time:
            # Who looks for the first time in a while, on a busy machine, cannot know yet that a tip in place rests there.
            self._overdue = min(self._overdue, beyond)
            if reached and beyond < self._overdue + 2.0 * REST_TIME:
                return None
            text = (
                f"{error * 1e6:+.2f} µm from the opening {p.settling_time:g} s after the ramp, "
                f"tolerance {p.tolerance * 1e6:g} µm, force {force:g} N"
            )
            return Outcome(False, False, True, text)
        return None
