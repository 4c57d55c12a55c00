# SPDX-License-Identifier: Apache-2.0
"""Contact of the tip with an object: a spring and a damper behind a free play, pushing only.

With the deflection delta = x + b (x behind D(s), b = g(T) + Creep) and the penetration
p = delta - free_play, the force on the tip is F = -(stiffness p + damping p') while p > 0 and F < 0,
else zero. A stiff object held for one sample would feed energy into the vibration, so the contact
is part of the equation of motion,

    a2 x'' + (a1 + s_p damping) x' + (1 + s_p stiffness) x
        = H_s(U) + s_p F_external - s_p stiffness (b - free_play),

stepped as exactly as the free tip. With an object in front, every sample is split into parts that are
each in or out of contact, PART radians of the vibration in contact at most.

Higher modes of the finger move the tip into the object and out of it, but its force acts on the first mode
alone: that is where the compliance is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.dynamics import (
    DynamicsParameters,
    ModesParameters,
    Motion,
    Propagator,
    move,
    propagator,
)
from piezo_control.parameters import parameter

PART = 0.05


@dataclass(frozen=True)
class ContactParameters:
    """Object in front of the tip, on the side of positive deflection; stiffness 0: none."""

    stiffness: float = parameter(
        0.0, "stiffness of the object; 0: nothing to touch", unit="N/m", low=0.0, high=1e5
    )
    damping: float = parameter(
        0.0, "damping of the object in contact", unit="N s/m", low=0.0, high=1e3
    )
    free_play: float = parameter(
        5e-6, "deflection at which the tip touches", unit="m", low=-1e-3, high=1e-3
    )


class Tip(NamedTuple):
    """Motion of the tip over one of `parts` parts of a sample, free and in contact."""

    parts: int
    free: Propagator
    touching: Propagator
    stiffness: float
    damping: float
    free_play: float
    elastic_constant: float
    a2: float  # of the denominator of D(s), s²
    a1: float  # s
    sample_time: float
    shares: list[float]  # of the static deflection, one for each mode, the first one's first
    higher: list[float]  # propagators of the modes but the first, four numbers each


def discretize(
    contact: ContactParameters,
    dynamics: DynamicsParameters,
    modes: ModesParameters,
    sample_time: float,
) -> Tip:
    """Return the tip's exact motion for one sample time (s)."""
    a2, a1, _ = dynamics.denominator
    parts = parts_of(a2, dynamics.elastic_constant, contact.stiffness, sample_time)
    higher: list[float] = []
    for hertz, damping in zip(modes.frequency_hz, modes.damping):
        omega = 2.0 * math.pi * hertz
        higher += propagator(1.0 / omega**2, 2.0 * damping / omega, 1.0, sample_time / parts)
    return tip_of(
        a2,
        a1,
        dynamics.elastic_constant,
        contact.stiffness,
        contact.damping,
        contact.free_play,
        sample_time,
        parts,
        [1.0 - sum(modes.share), *modes.share],
        higher,
    )


def parts_of(a2: float, elastic_constant: float, stiffness: float, sample_time: float) -> int:
    """Return how many parts a sample is split into; a step function too, for fingers that deviate."""
    if stiffness == 0.0:
        return 1
    fastest = math.sqrt((1.0 + elastic_constant * stiffness) / a2)
    return math.ceil(sample_time * fastest / PART)


def tip_of(
    a2: float,
    a1: float,
    elastic_constant: float,
    stiffness: float,
    damping: float,
    free_play: float,
    sample_time: float,
    parts: int,
    shares: list[float],
    higher: list[float],
) -> Tip:
    """Return the tip's exact motion of these numbers; a step function too, for fingers that deviate."""
    total_damping = a1 + elastic_constant * damping
    total_stiffness = 1.0 + elastic_constant * stiffness
    return Tip(
        parts=parts,
        free=propagator(a2, a1, 1.0, sample_time / parts),
        touching=propagator(a2, total_damping, total_stiffness, sample_time / parts),
        stiffness=stiffness,
        damping=damping,
        free_play=free_play,
        elastic_constant=elastic_constant,
        a2=a2,
        a1=a1,
        sample_time=sample_time,
        shares=shares,
        higher=higher,
    )


def contact_force(tip: Tip, deflection: float, speed: float) -> float:
    """Return the object's force on the tip (N), zero or negative."""
    if tip.stiffness == 0.0 or deflection <= tip.free_play:
        return 0.0
    return min(0.0, -tip.stiffness * (deflection - tip.free_play) - tip.damping * speed)


def move_tip(motion: Motion, tip: Tip, target: float, offset: float) -> None:
    """Advance `motion` by one sample.

    `target` is H_s(U) + s_p F_external, `offset` is b = g(T) + Creep, both held within the sample (m).
    """
    compliance = tip.elastic_constant * tip.stiffness
    first = tip.shares[0] * target
    for _ in range(tip.parts):
        beside = offset
        for i in range(1, len(motion.x)):
            beside += motion.x[i]
        if contact_force(tip, motion.x[0] + beside, motion.v[0]) < 0.0:
            held = (first - compliance * (beside - tip.free_play)) / (1.0 + compliance)
            move(motion, tip.touching, held)
        else:
            move(motion, tip.free, first)
        for i in range(1, len(motion.x)):
            j = 4 * (i - 1)
            own = Propagator(tip.higher[j], tip.higher[j + 1], tip.higher[j + 2], tip.higher[j + 3])
            move(motion, own, tip.shares[i] * target, i)
