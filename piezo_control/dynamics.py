# SPDX-License-Identifier: Apache-2.0
"""Vibration of the cantilever: D(s) = 1 / (a2 s² + a1 s + 1), stepped exactly.

Source: paper eq. 3-5. The actuated deflection and the elastic deflection s_p F share D(s), so both
are summed into one static target ahead of it. The target is constant within a sample, hence the step

    x(t+h) = x* + xx (x - x*) + xv v,        v(t+h) = vx (x - x*) + vv v

is the exact solution at any sample time h, whatever the damping.

Higher bending modes, where a finger has any, stand beside the paper's one with a share of the static
deflection each, of either sign (the sign of their shape at the tip):

    D(s) = (1 - sum_i share_i) / (a2 s² + a1 s + 1) + sum_i share_i / (s²/w_i² + 2 zeta_i s/w_i + 1)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import ParameterError, parameter


@dataclass(frozen=True)
class DynamicsParameters:
    """Denominator of D(s) and elastic constant; the defaults are 666.6 Hz, damping ratio 0.017."""

    denominator: tuple[float, ...] = parameter(
        (5.7e-8, 8.1e-6, 1.0), "denominator of D(s), highest power first; D(0) = 1", low=0.0
    )
    # Tip stiffness 3 E I / L³ of 15 x 2 x 0.3 mm with a mean modulus of 80 GPa: 320 N/m.
    elastic_constant: float = parameter(
        3.1e-3, "elastic constant s_p: deflection per tip force", unit="m/N", low=0.0, high=10.0
    )

    def __post_init__(self) -> None:
        if len(self.denominator) != 3 or self.denominator[2] != 1.0 or min(self.denominator) <= 0:
            raise ParameterError(
                f"'denominator' is {self.denominator}, must be three positive numbers, the last 1.0"
            )


@dataclass(frozen=True)
class ModesParameters:
    """Higher bending modes beside that of the denominator; arrays of equal length, empty: none."""

    frequency_hz: tuple[float, ...] = parameter((), "natural frequencies", unit="Hz", low=1.0)
    damping: tuple[float, ...] = parameter((), "damping ratios", low=1e-4, high=1.0)
    share: tuple[float, ...] = parameter(
        (), "parts of the static deflection, of either sign", low=-0.9, high=0.9
    )

    def __post_init__(self) -> None:
        lengths = [len(self.frequency_hz), len(self.damping), len(self.share)]
        if len(set(lengths)) > 1:
            raise ParameterError(
                f"'frequency_hz', 'damping' and 'share' of the modes have {lengths[0]}, {lengths[1]} and "
                f"{lengths[2]} elements, must have equally many"
            )
        if sum(self.share) >= 1.0:
            raise ParameterError(
                f"'share' is {list(self.share)}, must leave something to the first mode: a sum below 1"
            )


class Propagator(NamedTuple):
    """Free motion over one step: (x, v) goes to (xx x + xv v, vx x + vv v)."""

    xx: float
    xv: float
    vx: float
    vv: float


def propagator(inertia: float, damping: float, stiffness: float, time: float) -> Propagator:
    """Return the exact motion of ``inertia x'' + damping x' + stiffness x = 0`` over `time` (s).

    Underdamped, critical and overdamped systems alike; no intermediate value overflows.
    """
    decay = 0.5 * damping / inertia
    square = stiffness / inertia
    discriminant = decay * decay - square
    if discriminant < 0.0:
        frequency = math.sqrt(-discriminant)
        envelope = math.exp(-decay * time)
        even = envelope * math.cos(frequency * time)
        odd = envelope * math.sin(frequency * time) / frequency
    elif discriminant == 0.0:
        even = math.exp(-decay * time)
        odd = time * even
    else:
        spread = math.sqrt(discriminant)
        slow = math.exp(-square / (decay + spread) * time)
        even = 0.5 * slow * (1.0 + math.exp(-2.0 * spread * time))
        odd = -0.5 * slow * math.expm1(-2.0 * spread * time) / spread
    return Propagator(even + decay * odd, odd, -square * odd, even - decay * odd)


class Motion(NamedTuple):
    """Position (m) and speed (m/s) of every mode, changed in place: lists (or float64 arrays)."""

    x: list[float]
    v: list[float]


def move(motion: Motion, free: Propagator, target: float, mode: int = 0) -> None:
    """Advance one mode of `motion` by one step towards the static `target` (m)."""
    x = motion.x[mode] - target
    v = motion.v[mode]
    motion.x[mode] = target + (free.xx * x + free.xv * v)
    motion.v[mode] = free.vx * x + free.vv * v
