# SPDX-License-Identifier: Apache-2.0
"""A finger that stops at a force and holds it, without a force sensor: computed loops, simulated objects."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from piezo_control.dynamics import DynamicsParameters
from piezo_control.profile import Profile
from piezo_control.sensorless import Sensorless, SensorlessParameters
from piezo_control.touch import Touch, TouchParameters
from piezo_sim.engine import run_touching
from piezo_sim.experiment.sensorless import identified
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.plant.contact import ContactParameters
from piezo_sim.temperature import TemperatureParameters

H = 1e-4  # s
DEFAULTS = TouchParameters()
ELASTIC = DEFAULTS.elastic_constant
BEGIN = 0.1  # s
AWAY = 5e-6  # m, from the tip at rest to the object
STIFFNESSES = (300.0, 3000.0, 1e4, 1e5)  # N/m; a tip has 323
MODEL_ERROR = {"prandtl_ishlinskii": 0.03, "truth": 0.1}
"""What identified models of these plants are off by, as a share of the way."""
LIMIT = 2e-4  # N


# --- the loops, computed ----------------------------------------------------------------------------


def spectral_radius(branch, stiffness, resonance=1.0, damping=1.0):
    """Return that of one of the two loops in contact, from the equation of motion alone.

    State: x, v, the reading that is on its way, the low-pass, the command.
    """
    a2, a1, _ = DynamicsParameters().denominator
    a2, a1 = a2 / resonance**2, a1 * damping / resonance
    motion = np.zeros((3, 3))
    motion[0, 1] = 1.0
    motion[1] = -(1.0 + ELASTIC * stiffness) / a2, -a1 / a2, 1.0 / a2
    motion = expm(motion * H)[:2]  # x, v under a held command
    rate = H / (DEFAULTS.filter_time + H)
    one_sample = np.zeros((6, 6))
    one_sample[2, 0] = 1.0  # the reading of now comes out a sample later
    out = np.eye(6)
    seen = -out[2] + (out[5] if branch == "force" else 0.0)  # expected or reference, minus reading
    once = (1.0 - rate) * out[3] + rate * seen
    twice = (1.0 - rate) * out[4] + rate * once
    gain = -DEFAULTS.force_rate * H if branch == "force" else DEFAULTS.position_rate * H
    command = out[5] + gain * twice
    one_sample[3], one_sample[4], one_sample[5] = once, twice, command
    one_sample[:2] = motion[:, :2] @ out[:2] + np.outer(motion[:, 2], command)
    return max(abs(np.linalg.eigvals(one_sample)))


@pytest.mark.parametrize("branch", ["position", "force"])
def test_both_loops_are_stable_whatever_the_tip_touches(branch):
    for stiffness in (0.0, *np.logspace(0, 5, 101)):
        for resonance in (0.9, 1.0, 1.1):
            for damping in (0.5, 1.0, 2.0):
                radius = spectral_radius(branch, stiffness, resonance, damping)
                # with nothing to touch, the force loop keeps its integrator: one eigenvalue is 1
                assert radius < 1.0 or (
                    stiffness == 0.0 and branch == "force" and radius < 1 + 1e-9
                )


# --- simulated objects ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Models of both plants, identified from recordings through their sensors, as on a bench."""
    return {plant: identified(plant, tmp_path_factory.mktemp(plant)) for plant in MODEL_ERROR}


def touch_of(plant: str) -> TouchParameters:
    return TouchParameters(model_error=MODEL_ERROR[plant])


def close(plant, models, contact, degc=22.0, speed=500e-6, target=12e-6, hold=0.5, limit=LIMIT):
    """Close at `speed` (m/s) on an object; return the run, the estimate and the sample of the contact."""
    arrives = BEGIN + target / speed
    got, push = run_touching(
        CantileverParameters(plant=plant, contact=contact),
        touch_of(plant),
        models[plant],
        TemperatureParameters(base_degc=degc),
        Profile([BEGIN, arrives], [0.0, target], linear=True),
        Profile([0.0], [limit]),
        round((arrives + hold) / H),
    )
    return got, push, int(np.argmax(got.total_force < 0.0))


TOLD = {"prandtl_ishlinskii": 0.02e-3, "truth": 0.03e-3}
"""What the push is told to within (N): it was measured to be, see docs/touch.md."""


@pytest.mark.parametrize("degc", [22.0, 32.0])
@pytest.mark.parametrize("plant", MODEL_ERROR)
def test_closing_stops_at_the_force_and_holds_it(plant, degc, models):
    for stiffness in STIFFNESSES:
        for speed in (10e-6, 500e-6):
            got, push, touched = close(
                plant, models, ContactParameters(stiffness, 0.05, AWAY), degc, speed
            )
            force = -got.total_force
            name = f"{plant}, {degc} degC, {stiffness:g} N/m, {speed * 1e6:g} um/s"
            assert touched > BEGIN / H, name
            assert np.ptp(force[-200:]) < 0.05 * LIMIT, name  # at rest, no bouncing
            assert push[-2000:].mean() == pytest.approx(LIMIT, rel=0.02), name
            assert force[-2000:].mean() == pytest.approx(LIMIT, abs=TOLD[plant]), name
            assert force.max() < LIMIT + TOLD[plant], name


@pytest.mark.parametrize("damping", [0.0, 0.05])
def test_a_wall_at_full_speed_is_met_no_faster_than_the_finger_can_stop(damping, models):
    """A tip of modal mass a2 / s_p that meets a spring k at v pushes with v sqrt(k m) at most."""
    plant, limit, stiffness = "prandtl_ishlinskii", 1e-3, 1e5
    touch = touch_of(plant)
    got, push, touched = close(
        plant, models, ContactParameters(stiffness, damping, AWAY), target=20e-6, limit=limit
    )
    # Ringing from the start of the ramp may bring the tip at twice the command's speed.
    speed = np.max(np.diff(got.true_deflection[touched - 16 : touched + 1])) / H
    assert (
        speed < 2.1 * touch.force_rate * ELASTIC * limit
    )  # 310 of the 500 µm/s that are asked for
    mass = DynamicsParameters().denominator[0] / ELASTIC
    force = -got.total_force
    assert force.max() < 1.2 * limit + speed * math.sqrt(stiffness * mass)
    assert push[-2000:].mean() == pytest.approx(limit, rel=0.02)
    means = force[: len(force) // 50 * 50].reshape(-1, 50).mean(axis=1)  # of 5 ms
    assert means.max() < 1.1 * limit


@pytest.mark.parametrize("plant", MODEL_ERROR)
def test_the_force_is_held_while_the_temperature_rises(plant, models):
    """10 degC in 5 s move a free tip by 1.5 µm and its stroke by 6 %; 1.5 µm are 0.48 mN on a wall."""
    limit = 1e-3
    for stiffness in (300.0, 1e5):
        got, _ = run_touching(
            CantileverParameters(plant=plant, contact=ContactParameters(stiffness, 0.05, AWAY)),
            touch_of(plant),
            models[plant],
            TemperatureParameters(
                profile="ramp", base_degc=22.0, amplitude_degc=10.0, start=1.0, duration=5.0
            ),
            Profile([BEGIN, 0.5], [0.0, 20e-6], linear=True),
            Profile([0.0], [limit]),
            round(8.0 / H),
        )
        force = -got.total_force[round(1.0 / H) :]
        held = force[0]
        assert np.max(np.abs(force - held)) < 0.15e-3, (plant, stiffness)
        assert 0.8 * limit < force.min(), (plant, stiffness)  # nothing is dropped


def test_the_first_rise_of_a_finger_of_another_class_is_not_taken_for_a_push(models):
    """After 8 µm the other way: without its virgin share it is, with 0.36 mN, and never arrives."""
    got, push = run_touching(
        CantileverParameters(plant="truth", contact=ContactParameters(1e3, 0.05, AWAY)),
        touch_of("truth"),
        models["truth"],
        TemperatureParameters(),
        Profile([BEGIN, 0.2, 0.4], [0.0, -8e-6, 12e-6], linear=True),
        Profile([0.0], [LIMIT]),
        9000,
    )
    assert np.max(np.abs(push[got.total_force == 0.0])) < 0.06e-3
    assert -got.total_force[-1000:].mean() == pytest.approx(LIMIT, rel=0.1)


def test_position_is_reached_and_kept_where_nothing_is_in_the_way(models):
    got, push, _ = close("prandtl_ishlinskii", models, ContactParameters())
    assert np.mean(got.true_deflection[-2000:]) == pytest.approx(12e-6, abs=5e-9)
    assert np.max(np.abs(push)) < 0.5 * LIMIT


def test_an_object_that_is_let_go_is_left_without_a_jump(models):
    """The reference goes back: one integrator, so the command moves no faster than its two wishes say."""
    touch = touch_of("prandtl_ishlinskii")
    got, _ = run_touching(
        CantileverParameters(contact=ContactParameters(3e3, 0.05, AWAY)),
        touch,
        models["prandtl_ishlinskii"],
        TemperatureParameters(),
        Profile([BEGIN, 0.3, 0.6, 0.8], [0.0, 8e-6, 8e-6, 0.0], linear=True),
        Profile([0.0], [LIMIT]),
        round(1.2 / H),
    )
    behind = np.max(np.abs(got.reference - got.true_deflection))
    fastest = 40e-6 * H + touch.position_rate * H * behind
    assert np.max(np.abs(np.diff(got.command))) < 1.05 * fastest
    assert np.all(got.total_force[-1000:] == 0.0)
    assert np.mean(got.true_deflection[-1000:]) == pytest.approx(0.0, abs=0.02e-6)


def law_of(parameters: TouchParameters = DEFAULTS) -> Touch:
    return Touch(parameters, H, -22e-6, 22e-6)


def test_engine_and_classes_give_the_same_commands():
    plant = CantileverParameters(contact=ContactParameters(1e3, 0.0, 1e-6))
    reference = Profile([0.0, 0.02], [0.0, 4e-6], linear=True)
    limit = Profile([0.0], [LIMIT])
    models = SensorlessParameters()
    got, push = run_touching(
        plant, DEFAULTS, models, TemperatureParameters(), reference, limit, 400, compiled=False
    )
    law, feedforward, finger = law_of(), Sensorless(models, H, 22.0), Cantilever(plant)
    for n in range(400):
        command = law.step(got.reference[n], finger.measure(), feedforward.predicted, LIMIT)
        assert (command, law.push) == (got.command[n], push[n])
        voltage = feedforward.lead(command, 22.0)
        assert voltage == got.voltage[n]
        finger.advance(voltage, 22.0)


@pytest.mark.parametrize(
    "inputs, message",
    [
        ((math.nan, 0.0, 0.0, 1e-3), "reference is nan"),
        ((0.0, math.inf, 0.0, 1e-3), "deflection is inf"),
        ((0.0, 0.0, math.nan, 1e-3), "expected is nan"),
        ((0.0, 0.0, 0.0, -1e-3), "max_force is -0.001"),
        ((0.0, 0.0, 0.0, math.nan), "max_force is nan"),
    ],
)
def test_what_is_no_number_is_refused_and_changes_nothing(inputs, message):
    law, untouched = law_of(), law_of()
    with pytest.raises(ValueError, match=message):
        law.step(*inputs)
    assert law.state == untouched.state


def test_the_finger_never_asks_for_more_than_its_own_limit():
    """Nothing moves, and much is missing: the command goes on at the rate of the smaller force."""
    low, high = law_of(TouchParameters(force_limit=1e-4)), law_of()
    for _ in range(100):
        commands = low.step(20e-6, 0.0, 0.0, math.inf), high.step(20e-6, 0.0, 0.0, 1e-4)
        assert commands[0] == commands[1]
    assert commands[0] == pytest.approx(100 * DEFAULTS.force_rate * H * ELASTIC * 1e-4)
