# SPDX-License-Identifier: Apache-2.0
"""Stability of a finger that feels: computed, refused where it swings up, and the same on the engine."""

import math
from dataclasses import replace

import numpy as np
import pytest

from piezo_control.design.touching import FORCE, POSITION, check_stable, spectral_radius
from piezo_control.dynamics import DynamicsParameters
from piezo_control.parameters import ParameterError
from piezo_control.profile import Profile
from piezo_control.sensorless import SensorlessParameters
from piezo_control.touch import TouchParameters
from piezo_sim.engine import run_touching
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

H = 1e-4  # s
DEFAULTS = TouchParameters()
STIFFNESSES = (0.0, *np.logspace(0, 5, 101))  # N/m


def finger(frequency, damping=0.017):
    w = 2.0 * math.pi * frequency
    return DynamicsParameters(denominator=(1.0 / w**2, 2.0 * damping / w, 1.0))


@pytest.mark.parametrize("branch", [POSITION, FORCE])
def test_both_loops_are_stable_whatever_the_tip_touches(branch):
    a2, a1, one = DynamicsParameters().denominator
    for resonance in (0.9, 1.0, 1.1):
        for damping in (0.5, 1.0, 2.0):
            denominator = (a2 / resonance**2, a1 * damping / resonance, one)
            tip = DynamicsParameters(denominator=denominator)
            for stiffness in STIFFNESSES:
                radius = spectral_radius(branch, DEFAULTS, tip, H, 1, stiffness)
                # with nothing to touch, the force loop keeps its integrator: one eigenvalue is 1
                assert radius < 1.0 or (
                    stiffness == 0.0 and branch == FORCE and radius < 1.0 + 1e-9
                )


@pytest.mark.parametrize("frequency, radius", [(200.0, 1.0011), (150.0, 1.0044), (100.0, 1.0073)])
def test_the_radius_of_slow_fingers_is_that_of_another_computation(frequency, radius):
    """The matrix exponential of x, v and a held command in place of the propagator, with scipy."""
    worst = max(
        spectral_radius(POSITION, DEFAULTS, finger(frequency), H, 1, k) for k in STIFFNESSES
    )
    assert worst == pytest.approx(radius, abs=1e-4)


@pytest.mark.parametrize("frequency", [20.0, 100.0, 200.0, 400.0])
def test_a_slow_finger_is_refused_with_gains_that_are_not(frequency):
    tip = finger(frequency)
    try:
        check_stable(DEFAULTS, tip, H, 1)
        assert frequency == 400.0
    except ParameterError as error:
        words = str(error)
        assert f"{frequency:g} Hz" in words and "must be at most 1" in words
        numbers = [float(part.split()[0].rstrip(",")) for part in words.split("' is ")[1:2]]
        numbers.append(float(words.split("'touch.force_rate' ")[1].split()[0]))
        numbers.append(float(words.split("'touch.filter_time' ")[1]))
        names = ("position_rate", "force_rate", "filter_time")
        check_stable(replace(DEFAULTS, **dict(zip(names, numbers))), tip, H, 1)


@pytest.mark.parametrize("delay", [0, 1, 2, 3])
def test_the_papers_finger_may_be_late(delay):
    check_stable(DEFAULTS, DynamicsParameters(), H, delay)


@pytest.mark.parametrize("frequency, is_stable", [(100.0, False), (150.0, False), (250.0, True)])
def test_the_engine_swings_up_where_that_is_computed(frequency, is_stable):
    tip = finger(frequency)
    got, _ = run_touching(
        CantileverParameters(dynamics=tip),
        DEFAULTS,
        SensorlessParameters(dynamics=tip),
        TemperatureParameters(),
        Profile([0.1], [5e-6]),
        Profile([0.0], [1e-3]),
        30000,
    )
    assert (np.ptp(got.true_deflection[-2000:]) < 0.1e-6) == is_stable
    if is_stable:
        check_stable(DEFAULTS, tip, H, 1)
    else:
        with pytest.raises(ParameterError):
            check_stable(DEFAULTS, tip, H, 1)
