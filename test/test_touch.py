# SPDX-License-Identifier: Apache-2.0
"""A finger that stops at a force and holds it, without a force sensor: computed loops, simulated objects."""

import math
from itertools import pairwise

import numpy as np
import pytest

from piezo_control.dynamics import DynamicsParameters
from piezo_control.profile import Profile
from piezo_control.sensorless import Sensorless, SensorlessParameters
from piezo_control.touch import LOOPS, PLAY, Touch, TouchParameters, advance
from piezo_sim.engine import run_touching
from piezo_sim.experiment.sensorless import identified
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.plant.contact import ContactParameters
from piezo_sim.temperature import TemperatureParameters

H = 1e-4  # s
DEFAULTS = TouchParameters()
ELASTIC = DynamicsParameters.elastic_constant
BEGIN = 0.1  # s
AWAY = 5e-6  # m, from the tip at rest to the object
STIFFNESSES = (300.0, 3000.0, 1e4, 1e5)  # N/m; a tip has 323
MODEL_ERROR = {"prandtl_ishlinskii": 0.03, "truth": 0.1}
"""What identified models of these plants are off by, as a share of the way."""
LIMIT = 2e-4  # N
AIM = 1.0 - DEFAULTS.force_margin
"""Share of a limit that is held."""


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
            assert push[-2000:].mean() == pytest.approx(AIM * LIMIT, rel=0.02), name
            assert force[-2000:].mean() == pytest.approx(AIM * LIMIT, abs=TOLD[plant]), name
            assert force.max() <= LIMIT, name


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
    assert push[-2000:].mean() == pytest.approx(AIM * limit, rel=0.02)
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
    assert -got.total_force[-1000:].mean() == pytest.approx(AIM * LIMIT, rel=0.1)


def press(approach, contact, limit=LIMIT, touch=DEFAULTS):
    """Return true force and estimate (N) of a finger that is its models, with `approach` (m) from 0.2 s on."""
    reference = Profile(
        [BEGIN, *(2 * BEGIN + H * np.arange(len(approach)))], [0.0, *approach], linear=True
    )
    got, push = run_touching(
        CantileverParameters(contact=contact),
        touch,
        SensorlessParameters(),
        TemperatureParameters(),
        reference,
        Profile([0.0], [limit]),
        len(approach) + round(2 * BEGIN / H),
    )
    return -got.total_force, push


@pytest.mark.parametrize("stiffness", [100.0, 300.0, 1e3, 1e5])
@pytest.mark.parametrize("model_error", MODEL_ERROR.values())
def test_what_was_learned_from_an_object_is_given_back_when_it_is_felt(stiffness, model_error):
    """A finger that is its models pushes with what it is told to; on 100 N/m it learned 0.02 mN with an error of 0.1."""
    closing = np.minimum(500e-6 * H * np.arange(8000), 12e-6)
    contact = ContactParameters(stiffness, 0.05, AWAY)
    force, push = press(closing, contact, touch=TouchParameters(model_error=model_error))
    assert force[-2000:].mean() == pytest.approx(AIM * LIMIT, rel=0.01)
    assert push[-2000:].mean() == pytest.approx(AIM * LIMIT, rel=0.01)


@pytest.mark.parametrize(
    "stiffness, model_error, speed, amplitude, frequency",
    [
        (100.0, 0.03, 100e-9, 0.5e-6, 20.0),
        (300.0, 0.03, 100e-9, 0.5e-6, 20.0),
        (400.0, 0.03, 100e-9, 0.5e-6, 20.0),
        (1000.0, 0.03, 100e-9, 0.2e-6, 50.0),
        (3000.0, 0.1, 100e-9, 0.2e-6, 50.0),
        (200.0, 0.03, 1e-6, 0.5e-6, 50.0),
        (300.0, 0.03, 10e-9, 0.0, 0.0),
    ],
)
def test_a_reference_that_shakes_or_creeps_passes_no_limit(
    stiffness, model_error, speed, amplitude, frequency
):
    """To and fro is no way on which the models could be off, nor is what rises while the finger closes drift."""
    time = H * np.arange(round(min(2.5e-6 / speed, 300.0) / H))
    shaken = 4.9e-6 + speed * time + amplitude * np.sin(2.0 * np.pi * frequency * time)
    contact = ContactParameters(stiffness, 0.05, AWAY)
    force, push = press(shaken, contact, touch=TouchParameters(model_error=model_error))
    assert force.max() < LIMIT + TOLD["prandtl_ishlinskii"]
    assert np.max(np.abs(push - force)) < 0.03e-3


def test_a_random_walk_strikes_no_blows_on_a_hard_wall():
    """Opening faster than it closes sets a finger ringing: the wall was hit with six times the limit."""
    every = 5  # samples, white noise behind a low-pass of 20 Hz
    kept = math.exp(-2.0 * math.pi * 20.0 * every * H)
    strongest = []
    for seed in range(3, 12):
        walk = [0.0]
        for step in np.random.default_rng(seed).standard_normal(20000):
            walk.append(kept * walk[-1] + 0.5e-6 * math.sqrt(1.0 - kept**2) * step)
        walk = np.interp(np.arange(100000), every * np.arange(len(walk)), walk)
        force, _ = press(6e-6 + walk, ContactParameters(1e5, 0.05, AWAY))
        strongest.append(force.max())
    # A tip of modal mass a2 / s_p that meets a spring k at v; ringing brings it at twice the command's speed, and
    # at more where it was set ringing by several turns of the walk.
    speed = 2.1 * DEFAULTS.force_rate * ELASTIC * LIMIT
    blow = speed * math.sqrt(1e5 * DynamicsParameters().denominator[0] / ELASTIC)
    assert 0.9 * LIMIT < np.median(strongest) < LIMIT + blow
    assert max(strongest) < LIMIT + 2.0 * blow


def test_a_limit_below_the_least_that_is_felt_is_no_drift():
    limit = 0.4 * DEFAULTS.touch_force
    force, _ = press(np.full(300000, 8e-6), ContactParameters(3000.0, 0.05, AWAY), limit)
    assert force.max() < 1.2 * limit


def test_loops_within_loops_bring_back_what_was_learned_at_their_turns():
    """Whatever the command did since the outermost turn, and always as much as is allowed was learned."""
    law = law_of()
    c, s = law._coefficients, law.state
    turns = [12e-6 * (-0.8) ** n for n in range(LOOPS + 4)]
    inwards = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise([0.0, *turns])])
    shaking = turns[-1] + 0.4e-6 * np.sin(np.linspace(0.0, 200.0, 20000))
    outwards = np.linspace(shaking[-1], turns[0], 500)
    shares, ways = [], []
    for command in (*inwards, *shaking, *outwards):
        s.command[0] = command
        trust, bound = advance(c, s)
        s.share[0] = min(s.share[0] + trust, bound)
        shares.append(s.share[0])
        ways.append(s.way[0])
    outermost = turns[0] - PLAY
    at_turn = c.model_error * outermost
    assert shares[199] == pytest.approx(at_turn)
    bound = at_turn + c.model_error * np.abs(outermost - np.array(ways))
    assert np.max((shares - bound)[199:]) < 1e-12
    assert shares[-1] == pytest.approx(at_turn, abs=1e-12)


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
    return Touch(parameters, ELASTIC, H, -22e-6, 22e-6)


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
    assert commands[0] == pytest.approx(100 * DEFAULTS.force_rate * H * ELASTIC * AIM * 1e-4)
