# SPDX-License-Identifier: Apache-2.0
"""The shipped `robust` controller on the nonlinear finger: hysteresis, creep, heat, sensor and delay."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import cont2discrete, ss2tf

from piezo_control.feedback import Feedback, FeedbackParameters, read_controller
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.metrics import settling_time, step_metrics
from piezo_control.parameters import build, load
from piezo_control.profile import Profile
from piezo_control.sensorless import SensorlessParameters
from piezo_sim.engine import run, run_led
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

PARAMS = Path(__file__).resolve().parents[1] / "params"
ROBUST = build(FeedbackParameters, load(PARAMS / "feedback_robust.yaml", "feedback"))
CONTROLLERS = {
    1: ROBUST,
    **{
        delay: build(
            FeedbackParameters, load(PARAMS / f"feedback_robust_delay_{delay}.yaml", "feedback")
        )
        for delay in (2, 3)
    },
}
H = 1e-4
FEEDFORWARD = FeedforwardParameters()
NOMINAL = CantileverParameters()
STEP_AT = 50
BOX = list(itertools.product((0.9, 1.0, 1.1), (0.5, 2.0), (0.9, 1.0, 1.1)))


def finger(resonance: float = 1.0, damping: float = 1.0, gain: float = 1.0) -> CantileverParameters:
    """A finger off the nominal one; the feedforward does not know."""
    a2, a1, _ = NOMINAL.dynamics.denominator
    moved = (a2 / resonance**2, a1 * damping / resonance, 1.0)
    weights = tuple(gain * weight for weight in NOMINAL.hysteresis.weights)
    return replace(
        NOMINAL,
        dynamics=replace(NOMINAL.dynamics, denominator=moved),
        hysteresis=replace(NOMINAL.hysteresis, weights=weights),
    )


def step_response(plant: CantileverParameters, degc: float, height: float):
    profile = Profile([0.0, STEP_AT * NOMINAL.sample_time], [0.0, height])
    temperatures = TemperatureParameters(base_degc=degc)
    done = run(plant, FEEDFORWARD, ROBUST, temperatures, profile, STEP_AT + 1000)
    time = done.time[STEP_AT:] - done.time[STEP_AT]
    return step_metrics(time, done.deflection[STEP_AT:], height)


def test_rate_delay_and_resolution_are_those_asked_for():
    assert NOMINAL.sample_time == 1e-4
    assert NOMINAL.sensor.delay_samples == 1
    assert NOMINAL.sensor.resolution == 10e-9


@pytest.mark.parametrize("degc", [22.0, 32.0])
def test_full_step(degc):
    # 20 µm as in Fig. 13 of the paper; the specification is the paper's.
    found = step_response(finger(), degc, 20e-6)
    assert found.settling_5_reference_s <= 10e-3
    assert found.overshoot <= 0.005
    assert found.static_error <= 0.0005


@pytest.mark.parametrize("degc", [22.0, 32.0])
def test_worst_case_of_the_box(degc):
    # 18 µm: with a gain 10 % too small 20 µm are out of reach of 40 V. What the problem asks for, one sample
    # more: this metric counts samples.
    found = [step_response(finger(*factors), degc, 18e-6) for factors in BOX]
    assert max(m.settling_5_reference_s for m in found) <= 6.1e-3
    assert max(m.overshoot for m in found) <= 0.0049
    assert max(m.static_error for m in found) <= 0.0005


def test_warm_up_moves_the_held_deflection_by_less_than_half_a_micrometre():
    temperatures = TemperatureParameters(profile="step", start=0.1)
    done = run(finger(), FEEDFORWARD, ROBUST, temperatures, Profile([0.0], [20e-6]), 20_000)
    assert np.ptp(done.temperature) == 10.0
    assert np.abs(done.true_deflection[900:] - 20e-6).max() <= 0.5e-6


@pytest.mark.parametrize("damping", [0.5, 1.0])
@pytest.mark.parametrize("resonance", [0.9, 1.0, 1.1])
def test_force_step_stops_ringing(resonance, damping):
    # Open loop: 3 / (zeta omega) = 42 ms nominally.
    static = 3e-6
    force = Profile([0.0, 0.1], [0.0, static / NOMINAL.dynamics.elastic_constant])
    plant = finger(resonance, damping)
    done = run(
        plant, FEEDFORWARD, ROBUST, TemperatureParameters(), Profile([0.0], [5e-6]), 2000, force
    )
    after = done.true_deflection[1000:] - 5e-6
    assert np.abs(after).max() > static
    assert settling_time(done.time[1000:], after, 0.0, 0.05 * static) <= 15e-3


@pytest.mark.parametrize("degc", [22.0, 32.0])
@pytest.mark.parametrize(
    ("name", "spread", "gain", "settled"),
    [("following", 0.1, 0.1, 4e-3), ("following_adapted", 0.03, 0.02, 2.7e-3)],
)
def test_a_model_is_followed_at_any_temperature(name, spread, gain, settled, degc):
    """As the problems in params/ ask, with a sample and the sensor's resolution added."""
    controller, models, height = read_controller(name), SensorlessParameters(), 18e-6
    profile, samples = Profile([0.0, STEP_AT * H], [0.0, height]), STEP_AT + 400
    temperatures = TemperatureParameters(base_degc=degc)
    for factors in itertools.product(
        (1.0 - spread, 1.0, 1.0 + spread), (0.5, 2.0), (1.0 - gain, 1.0, 1.0 + gain)
    ):
        done, _ = run_led(
            finger(*factors), controller, models, temperatures, profile, samples, samples
        )
        found = step_metrics(done.time[STEP_AT:] - STEP_AT * H, done.deflection[STEP_AT:], height)
        assert found.settling_5_reference_s <= settled + H
        assert found.overshoot <= 0.0049 + NOMINAL.sensor.resolution / height
        assert done.clipped == 0


# By code that shares nothing with the certificate: scipy's sampling, polynomials, and a loop in Python.


def plant_polynomials(modes, gain):
    """Return numerator and denominator in z of gain times the sum of (share, rad/s, damping ratio)."""
    numerator, denominator = np.zeros(1), np.ones(1)
    for share, omega, zeta in modes:
        mode = cont2discrete(([gain * share], [omega**-2, 2.0 * zeta / omega, 1.0]), H, "zoh")
        numerator = np.polyadd(np.polymul(numerator, mode[1]), np.polymul(mode[0][0], denominator))
        denominator = np.polymul(denominator, mode[1])
    return numerator, denominator


def feedback_polynomials(controller):
    size = controller.order
    return ss2tf(
        np.reshape(controller.a, (size, size)), np.reshape(controller.b, (size, 1)),
        np.reshape(controller.c, (1, size)), [[controller.d]],
    )  # fmt: skip


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_no_second_mode_makes_it_unstable(delay):
    """A tenth of the deflection, damping ratio 0.017, either sign, anywhere above 2 kHz (beyond Nyquist too)."""
    numerator, denominator = feedback_polynomials(CONTROLLERS[delay])
    omega, zeta = 1.0 / np.sqrt(5.7e-8), 8.1e-6 / 2.0 / np.sqrt(5.7e-8)
    random = np.random.default_rng(7)
    frequencies = np.concatenate([np.linspace(2000.0, 5000.0, 31), random.uniform(5e3, 3e4, 10)])
    radius = []
    for hertz, share, resonance, gain in itertools.product(
        frequencies, (-0.1, 0.1), (0.9, 1.1), (0.9, 1.17)
    ):
        modes = (1.0 - share, resonance * omega, 0.5 * zeta), (share, 2.0 * np.pi * hertz, 0.017)
        b, a = plant_polynomials(modes, gain)
        a = np.polymul(a, [1.0] + [0.0] * delay)
        poles = np.roots(np.polyadd(np.polymul(a, denominator), np.polymul(b, numerator[0])))
        radius.append(np.abs(poles).max())
    assert max(radius) < 1.0


def test_the_fast_controller_does_become_unstable():
    """The textbook's mode at half of its damping: so the test above can fail."""
    fast = build(FeedbackParameters, load(PARAMS / "feedback_fast.yaml", "feedback"))
    numerator, denominator = feedback_polynomials(fast)
    modes = (0.92, 4188.5, 0.017), (0.08, 2.0 * np.pi * 4178.0, 0.0085)
    b, a = plant_polynomials(modes, 1.0)
    a = np.polymul(a, [1.0, 0.0])
    poles = np.roots(np.polyadd(np.polymul(a, denominator), np.polymul(b, numerator[0])))
    assert np.abs(poles).max() > 1.0


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_what_the_problem_asks_of_random_fingers(delay):
    """Settling, overshoot, force, Ms and noise gain of fingers in the box, each loop stepped in time."""
    random = np.random.default_rng(delay)
    controller = CONTROLLERS[delay]
    samples = 400
    for k in range(12):
        resonance, gain = random.choice([-1.0, 1.0], 2) if k < 6 else random.uniform(-1.0, 1.0, 2)
        omega = (1.0 + 0.1 * resonance) / np.sqrt(5.7e-8)
        zeta = 2.0 ** random.choice([-1.0, 1.0]) * 8.1e-6 / 2.0 / np.sqrt(5.7e-8)
        gain = 1.035 + 0.135 * gain
        a, b, c, _, _ = cont2discrete(
            (
                np.array([[0.0, 1.0], [-(omega**2), -2.0 * zeta * omega]]),
                np.array([[0.0], [omega**2]]),
                np.eye(2)[:1],
                np.zeros((1, 1)),
            ),
            H,
        )
        found = {}
        for source in ("reference", "force", "noise"):
            law, state, line = Feedback(controller), np.zeros((2, 1)), [0.0] * (delay + 1)
            readings, commands = [], []
            for n in range(samples):
                line = [*line[1:], state[0, 0]]
                noise = 1e-6 * (source == "noise" and n == 0)
                readings.append(line[0])
                command = law.step(1e-6 * (source == "reference"), line[0] + noise)
                commands.append(command)
                state = a @ state + b * (gain * command + 1e-6 * (source == "force"))
            found[source] = np.array(readings) * 1e6
            scatter = np.sqrt(np.sum(np.square(commands))) * 1e6
        assert np.abs(found["reference"][61:] - 1.0).max() <= 0.05  # 6 ms, one sample more
        assert found["reference"].max() <= 1.0049
        assert np.abs(found["force"][151:]).max() <= 0.05
        assert scatter <= 0.5
        z = np.exp(2j * np.pi * H * np.linspace(1.0, 4990.0, 4000))
        numerator, denominator = feedback_polynomials(controller)
        b, a = plant_polynomials([(1.0, omega, zeta)], gain)
        loop = np.polyval(numerator[0], z) / np.polyval(denominator, z) / z**delay
        loop *= np.polyval(b, z) / np.polyval(a, z)
        assert np.abs(1.0 / (1.0 + loop)).max() <= 1.53
        assert CONTROLLERS[delay].delay_samples == delay


@pytest.mark.parametrize("degc", [22.0, 32.0])
@pytest.mark.parametrize("kind", ["prandtl_ishlinskii", "truth"])
def test_the_shipped_finger_with_a_second_mode(kind, degc):
    """The nonlinear finger with the textbook's second mode, the amplifier's lag and the sensor's noise."""
    shipped = load(PARAMS / "finger_second_mode" / "cantilever.yaml", "cantilever")
    plant = replace(build(CantileverParameters, shipped), plant=kind)
    found = step_response(plant, degc, 18e-6)
    assert found.settling_5_reference_s <= 6.1e-3
    if kind == "prandtl_ishlinskii":  # that of the inverse; the other one is off by its hysteresis
        assert found.overshoot <= 0.005
        assert found.static_error <= 0.0005
