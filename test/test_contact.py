# SPDX-License-Identifier: Apache-2.0
"""Contact: against the differential equation with the force law of the module."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from piezo_control.dynamics import DynamicsParameters, ModesParameters, Motion
from piezo_sim.plant.contact import ContactParameters, contact_force, discretize, move_tip

DYNAMICS = DynamicsParameters()
A2, A1, _ = DYNAMICS.denominator
SOFTNESS = DYNAMICS.elastic_constant


def simulate(contact, target, offset, samples, sample_time):
    tip = discretize(contact, DYNAMICS, ModesParameters(), sample_time)
    motion = Motion([0.0], [0.0])
    path = []
    for _ in range(samples):
        move_tip(motion, tip, target, offset)
        path.append((motion.x[0], motion.v[0]))
    return tip, np.array(path)


def test_without_an_object_it_is_the_free_tip():
    _, free = simulate(ContactParameters(), 20e-6, 0.0, 500, 1e-4)
    _, far = simulate(ContactParameters(stiffness=1e4, free_play=1e-3), 20e-6, 0.0, 500, 1e-4)
    np.testing.assert_allclose(far[:, 0], free[:, 0], rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("stiffness", [50.0, 1000.0, 1e5])
@pytest.mark.parametrize("sample_time", [1e-5, 1e-4, 1e-3])
def test_rest_in_contact_is_the_equilibrium_of_two_springs(stiffness, sample_time):
    contact = ContactParameters(stiffness=stiffness, damping=0.5, free_play=5e-6)
    tip, path = simulate(contact, 20e-6, 1e-6, round(0.1 / sample_time), sample_time)
    compliance = SOFTNESS * stiffness
    deflection = (20e-6 + 1e-6 + compliance * 5e-6) / (1.0 + compliance)
    assert path[-1, 0] + 1e-6 == pytest.approx(deflection, rel=1e-9)
    force = contact_force(tip, path[-1, 0] + 1e-6, path[-1, 1])
    assert force == pytest.approx(-stiffness * (deflection - 5e-6), rel=1e-6)


@pytest.mark.parametrize("stiffness, damping", [(300.0, 0.0), (300.0, 0.02), (5000.0, 0.1)])
def test_bouncing_solves_the_differential_equation(stiffness, damping):
    contact = ContactParameters(stiffness=stiffness, damping=damping, free_play=5e-6)
    target, offset, end = 4e-6, 0.5e-6, 4e-3  # rings in and out of contact
    tip, path = simulate(contact, target, offset, 400, 1e-5)

    def law(_, y):
        x, v = y * 1e-6
        force = contact_force(tip, x + offset, v)
        return np.array([v, (target + SOFTNESS * force - A1 * v - x) / A2]) * 1e6

    time = np.arange(1, 401) * 1e-5
    exact = solve_ivp(law, (0.0, end), [0.0, 0.0], t_eval=time, rtol=1e-8, atol=1e-9, max_step=2e-6)
    assert np.max(exact.y[0]) * 1e-6 + offset > 5e-6  # it does touch
    late = 1e-5 / tip.parts * np.max(np.abs(path[:, 1]))  # touching is noticed a part late at most
    np.testing.assert_allclose(path[:, 0], exact.y[0] * 1e-6, rtol=0.0, atol=late)


@pytest.mark.parametrize("sample_time", [1e-5, 1e-4, 5e-4])
def test_a_stiff_object_feeds_no_energy_into_the_tip(sample_time):
    contact = ContactParameters(stiffness=1e5, damping=0.0, free_play=5e-6)
    tip, path = simulate(contact, 20e-6, 0.0, round(0.5 / sample_time), sample_time)
    penetration = np.maximum(path[:, 0] - 5e-6, 0.0)
    energy = (
        0.5 * (path[:, 0] - 20e-6) ** 2
        + 0.5 * A2 * path[:, 1] ** 2
        + 0.5 * SOFTNESS * 1e5 * penetration**2
    )
    at_rest = 0.5 * (20e-6) ** 2
    assert np.max(energy) < 1.05 * at_rest
    assert energy[-1] < np.min(energy[:20])


def test_a_higher_mode_touches_too_and_its_object_acts_on_the_first_mode():
    """Against an integration of both modes: the object sees their sum and pushes the first one."""
    share, omega, zeta = -0.2, 2.0 * np.pi * 2500.0, 0.05
    modes = ModesParameters(frequency_hz=(omega / (2.0 * np.pi),), damping=(zeta,), share=(share,))
    contact = ContactParameters(stiffness=300.0, free_play=4e-6)
    tip = discretize(contact, DYNAMICS, modes, 1e-5)
    motion = Motion([0.0, 0.0], [0.0, 0.0])
    got = []
    for _ in range(300):
        move_tip(motion, tip, 5e-6, 0.0)
        got.append(sum(motion.x))

    def law(_, y):
        x, v, z, w = y
        pull = SOFTNESS * -300.0 * max(x + z - 4.0, 0.0)
        first = ((1.0 - share) * 5.0 + pull - A1 * v - x) / A2
        return [v, first, w, omega**2 * (share * 5.0 - z) - 2.0 * zeta * omega * w]

    time = np.arange(1, 301) * 1e-5
    exact = solve_ivp(law, (0.0, 3e-3), np.zeros(4), t_eval=time, rtol=1e-9, max_step=2e-6).y
    free = simulate(ContactParameters(), 5e-6, 0.0, 300, 1e-5)[1][:, 0]
    assert np.max(np.abs(free - exact[0] * 1e-6)) > 1e-6  # the object and the share do matter
    np.testing.assert_allclose(got, (exact[0] + exact[2]) * 1e-6, rtol=0.0, atol=5e-9)


def test_the_object_only_pushes():
    contact = ContactParameters(stiffness=1000.0, damping=0.5, free_play=5e-6)
    tip, path = simulate(contact, 6e-6, 0.0, 2000, 1e-5)
    forces = [contact_force(tip, x, v) for x, v in path]
    assert min(forces) < 0.0
    assert max(forces) == 0.0
    assert contact_force(tip, 6e-6, -1.0) == 0.0  # damper would pull: it lets go
