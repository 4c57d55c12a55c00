"""Contact of the tip with an object: a spring and a damper behind a free play, pushing only.

With the deflection delta = x + b (x behind D(s), b = g(T) + Creep) and the penetration
p = delta - free_play, the force on the tip is F = -(stiffness p + damping p') while p > 0 and F < 0,
else zero. A stiff object held for one sample would feed energy into the vibration, so the contact
is part of the equation of motion,

    a2 x'' + (a1 + s_p damping) x' + (1 + s_p stiffness) x
        = H_s(U) + s_p F_external - s_p stiffness (b - free_play),

stepped as exactly as the free tip. Only a sample in which the tip touches or leaves is split, into
SPLIT parts that are each in or out of contact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from piezo_control.parameters import parameter
from piezo_sim.dynamics import DynamicsParameters, Propagator, move, propagator

SPLIT = 32


@dataclass(frozen=True)
class ContactParameters:
    """Object in front of the tip, on the side of positive deflection; stiffness 0: none."""

    stiffness: float = parameter(
        0.0, "stiffness of the object; 0: nothing to touch", unit="N/m", low=0.0, high=1e6
    )
    damping: float = parameter(
        0.0, "damping of the object in contact", unit="N s/m", low=0.0, high=1e3
    )
    free_play: float = parameter(
        5e-6, "deflection at which the tip touches", unit="m", low=-1e-3, high=1e-3
    )


class Tip(NamedTuple):
    """Motion of the tip, free and in contact, over a whole sample and over one part of it."""

    free: Propagator
    touching: Propagator
    free_part: Propagator
    touching_part: Propagator
    stiffness: float
    damping: float
    free_play: float
    elastic_constant: float


def discretize(contact: ContactParameters, dynamics: DynamicsParameters, sample_time: float) -> Tip:
    """Return the tip's exact motion for one sample time (s)."""
    inertia, damping, stiffness = dynamics.denominator
    softness = dynamics.elastic_constant
    touching = (damping + softness * contact.damping, stiffness + softness * contact.stiffness)
    return Tip(
        propagator(inertia, damping, stiffness, sample_time),
        propagator(inertia, *touching, sample_time),
        propagator(inertia, damping, stiffness, sample_time / SPLIT),
        propagator(inertia, *touching, sample_time / SPLIT),
        contact.stiffness,
        contact.damping,
        contact.free_play,
        softness,
    )


def contact_force(tip: Tip, deflection: float, speed: float) -> float:
    """Return the object's force on the tip (N), zero or negative."""
    if tip.stiffness == 0.0 or deflection <= tip.free_play:
        return 0.0
    return min(0.0, -tip.stiffness * (deflection - tip.free_play) - tip.damping * speed)


def move_tip(motion, tip: Tip, target: float, offset: float) -> None:
    """Advance `motion` = [x, v] by one sample.

    `target` is H_s(U) + s_p F_external, `offset` is b = g(T) + Creep, both held within the sample (m).
    """
    if tip.stiffness == 0.0:
        move(motion, tip.free, target)
        return
    compliance = tip.elastic_constant * tip.stiffness
    held = (target - compliance * (offset - tip.free_play)) / (1.0 + compliance)
    x = motion[0]
    v = motion[1]
    touching = contact_force(tip, x + offset, v) < 0.0
    if touching:
        move(motion, tip.touching, held)
    else:
        move(motion, tip.free, target)
    if (contact_force(tip, motion[0] + offset, motion[1]) < 0.0) != touching:
        motion[0] = x
        motion[1] = v
        for _ in range(SPLIT):
            if contact_force(tip, motion[0] + offset, motion[1]) < 0.0:
                move(motion, tip.touching_part, held)
            else:
                move(motion, tip.free_part, target)
