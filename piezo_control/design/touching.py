# SPDX-License-Identifier: Apache-2.0
"""Whether a finger that feels is stable: the two loops of :mod:`piezo_control.touch` in contact, computed.

The tip is its first mode with the spring k of an object beside its own, a2 x'' + a1 x' + (1 + s_p k) x = command,
stepped exactly. With the readings on their way, the low-pass and the integrator that is one linear system for each
wish; the loop is stable if no eigenvalue of either is above 1, whatever the stiffness.
"""

from __future__ import annotations

import numpy as np

from piezo_control.dynamics import DynamicsParameters, propagator
from piezo_control.parameters import ParameterError
from piezo_control.touch import TouchParameters

POSITION, FORCE = range(2)
STIFFNESSES = (0.0, *np.logspace(0.0, 5.0, 51))
"""Of objects (N/m) from none to a wall."""

UNSTABLE = 1.0 + 1e-9
"""With nothing to touch the integrator of the force stands still at an eigenvalue of 1."""


def spectral_radius(
    branch: int,
    touch: TouchParameters,
    dynamics: DynamicsParameters,
    sample_time: float,
    delay: int,
    stiffness: float,
) -> float:
    """Return that of the loop which follows a position or holds a force, per sample.

    `delay` is the number of samples from a command to the reading that tells of it, `stiffness` that of the object
    (N/m). State: x, v, the readings that are on their way, the low-pass, the command.
    """
    a2, a1, _ = dynamics.denominator
    softness = 1.0 / (1.0 + dynamics.elastic_constant * stiffness)
    free = propagator(a2, a1, 1.0 / softness, sample_time)
    n = delay + 5
    out = np.eye(n)
    x, v, seen = out[0], out[1], out[1 + delay if delay else 0]
    once, twice, command = out[-3], out[-2], out[-1]
    rate = sample_time / (touch.filter_time + sample_time)
    missing = (command if branch == FORCE else 0.0) - seen  # expected or reference, minus reading
    first = once + rate * (missing - once)
    second = twice + rate * (first - twice)
    gain = -touch.force_rate if branch == FORCE else touch.position_rate
    led = command + gain * sample_time * second
    away = x - softness * led
    x_next = softness * led + free.xx * away + free.xv * v
    v_next = free.vx * away + free.vv * v
    readings = [x, *out[2 : 1 + delay]][:delay]
    one_sample = np.array([x_next, v_next, *readings, first, second, led])
    return float(np.max(np.abs(np.linalg.eigvals(one_sample))))


def check_stable(
    touch: TouchParameters, dynamics: DynamicsParameters, sample_time: float, delay: int
) -> None:
    """Raise ParameterError for a finger that swings itself up, with the gains that its resonance allows."""
    worst, stiffness = max(
        (spectral_radius(branch, touch, dynamics, sample_time, delay, k), k)
        for branch in (POSITION, FORCE)
        for k in STIFFNESSES
    )
    if worst <= UNSTABLE:
        return
    slower = np.sqrt(DynamicsParameters().denominator[0] / dynamics.denominator[0])
    default = TouchParameters()
    raise ParameterError(
        f"force control swings up on a finger of {resonance(dynamics):.4g} Hz and {stiffness:.3g} N/m in front: its "
        f"spectral radius is {worst:.5f} at {sample_time:g} s and a delay of {delay} samples, must be at most 1; "
        f"for this resonance 'touch.position_rate' is {default.position_rate * slower:.3g}, 'touch.force_rate' "
        f"{default.force_rate * slower:.3g} and 'touch.filter_time' {default.filter_time / slower:.3g}"
    )


def resonance(dynamics: DynamicsParameters) -> float:
    """Return the natural frequency (Hz)."""
    return float(1.0 / (2.0 * np.pi * np.sqrt(dynamics.denominator[0])))
