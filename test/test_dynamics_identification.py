# SPDX-License-Identifier: Apache-2.0
"""D(s) and the elastic constant from the simulated finger, seen through its sensor."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import step as step_response

from piezo_control.dynamics import ModesParameters
from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification.dynamics import (
    DynamicsModel,
    identify_dynamics,
    need_vibration,
)
from piezo_control.identification.measurement import (
    Measurement,
    MeasurementError,
    read_measurement,
)
from piezo_sim.plant.amplifier import AmplifierParameters
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters

SAMPLE_TIME = 1e-4
# D(s) of the paper: 5.7e-8 s^2 + 8.1e-6 s + 1
FREQUENCY = 1.0 / math.sqrt(5.7e-8)
NONE = ModesParameters()
DAMPING = 8.1e-6 / (2.0 * math.sqrt(5.7e-8))


def measured(voltage, tip_force, modes=NONE, bandwidth_hz=0.0):
    """The default finger: 10 nm steps, 5 nm noise, one sample of delay, creep."""
    amplifier = AmplifierParameters(bandwidth_hz=bandwidth_hz)
    plant = Cantilever(
        CantileverParameters(sample_time=SAMPLE_TIME, modes=modes, amplifier=amplifier)
    )
    deflection = []
    for v, force in zip(voltage.tolist(), tip_force.tolist()):
        deflection.append(plant.measure())
        plant.advance(v, 22.0, force)
    count = len(voltage)

    def before(values):
        return np.concatenate((np.zeros(2), values))[:count]

    time = np.arange(count) * SAMPLE_TIME
    return Measurement(
        "sim",
        time,
        before(voltage),
        np.array(deflection),
        None,
        before(tip_force),
        np.arange(count),
    )


def step(amplitude, samples):
    return np.where(np.arange(samples) < 20, 0.0, amplitude)


def test_step_of_the_voltage_as_in_figure_3():
    """80 ms at 40 V: frequency to 0.5 %, damping to 10 %."""
    measurement = measured(step(40.0, 800), np.zeros(800))
    model = identify_dynamics(measurement, measurement.voltage)
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=0.005)
    assert model.damping_ratio == pytest.approx(DAMPING, rel=0.1)
    assert model.gain == pytest.approx(22e-6 / 40.0, rel=0.01)
    np.testing.assert_allclose(model.denominator, (5.7e-8, 8.1e-6, 1.0), rtol=0.1)


def test_sweep_behind_the_hysteresis():
    time = np.arange(0.0, 0.5, SAMPLE_TIME)
    sweep = 5.0 * np.sin(2.0 * np.pi * (300.0 * time + 0.5 * 1400.0 * time**2))
    measurement = measured(sweep, np.zeros(len(time)))
    static = deflection_history(HysteresisParameters(), measurement.voltage)
    model = identify_dynamics(measurement, static)
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=0.005)
    assert model.damping_ratio == pytest.approx(DAMPING, rel=0.1)
    assert model.gain == pytest.approx(1.0, rel=0.01)


def test_step_of_the_force_gives_the_elastic_constant():
    measurement = measured(np.zeros(1000), step(1e-3, 1000))
    model = identify_dynamics(measurement, measurement.tip_force)
    assert model.gain == pytest.approx(CantileverParameters().dynamics.elastic_constant, rel=0.005)
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=0.005)


def test_model_reproduces_an_analytic_step_response():
    """y = 1 - exp(-z w t) (cos w_d t + z w / w_d sin w_d t), exact at the samples."""
    frequency, damping = 300.0, 0.1
    time = np.arange(0.0, 0.1, 1e-3)
    damped = frequency * math.sqrt(1.0 - damping**2)
    decay = np.exp(-damping * frequency * time)
    ratio = damping * frequency / damped
    exact = 1e-6 * (1.0 - decay * (np.cos(damped * time) + ratio * np.sin(damped * time)))
    drive = np.concatenate(([0.0], np.ones(len(time) - 1)))  # held before its sample
    measurement = Measurement("step", time, drive, exact, None, None, np.arange(len(time)))
    model = identify_dynamics(measurement, drive)
    assert model.natural_frequency == pytest.approx(frequency, rel=1e-6)
    assert model.damping_ratio == pytest.approx(damping, rel=1e-6)
    np.testing.assert_allclose(model.deflection(time, drive), exact, rtol=0, atol=1e-12)


def test_constant_drive_is_refused():
    measurement = measured(step(40.0, 200), np.zeros(200))
    with pytest.raises(MeasurementError, match="the drive is constant"):
        identify_dynamics(measurement, np.ones(200))


@pytest.mark.parametrize("late", [0, 1, 3])
def test_a_delay_is_found_and_is_not_taken_for_damping(late):
    """Fitted without a delay, three samples turn the damping ratio of 0.017 into 0.05."""
    measurement = measured(step(20.0, 800), np.zeros(800))
    shifted = np.concatenate((np.zeros(late), measurement.deflection))[:800]
    model = identify_dynamics(replace(measurement, deflection=shifted), measurement.voltage)
    assert model.delay_samples(measurement.sample_time) == late
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=0.005)
    assert model.damping_ratio == pytest.approx(DAMPING, rel=0.1)


@pytest.mark.parametrize("damping", [0.01, 0.3, 0.9])
def test_a_vibration_under_noise_is_seen(damping):
    """2 % of the stroke, white: from a ringing finger to one that hardly overshoots."""
    time = np.arange(2000) * SAMPLE_TIME
    voltage = np.where(time < 0.01, 0.0, 20.0)
    exact = DynamicsModel(2.0 * np.pi * 300.0, damping, 5e-7, 0.0, 0.0, 0).deflection(time, voltage)
    noisy = exact + np.random.default_rng(0).normal(0.0, 0.02 * 1e-5, time.size)
    measurement = Measurement("sim", time, voltage, noisy, None, None, np.arange(time.size))
    model = identify_dynamics(measurement, voltage)
    need_vibration(measurement, voltage, model)
    assert model.natural_frequency == pytest.approx(2.0 * np.pi * 300.0, rel=0.03)


def test_the_width_of_slow_loops_is_not_taken_for_damping():
    """The p885 stack at 1 Hz: a resonance of 7.6 Hz, damped by 0.37, leaves 1.4 % of the stroke."""
    path = Path(__file__).parent / "data" / "p885_hysteresis" / "Model_Vi_Do.dat"
    measurement = read_measurement(path, {"voltage": "0", "deflection": "4:um"}, sample_time=5e-3)
    model = identify_dynamics(measurement, measurement.voltage)
    left = measurement.deflection - model.deflection(measurement.time, measurement.voltage)
    assert np.sqrt(np.mean(left**2)) < 0.02 * np.ptp(measurement.deflection)
    with pytest.raises(
        MeasurementError, match="no vibration is seen; drive the finger with a step"
    ):
        need_vibration(measurement, measurement.voltage, model)


@pytest.mark.parametrize(
    "modes",
    [
        NONE,
        ModesParameters((4178.0,), (0.017,), (0.08,)),  # the textbook's second bending mode
        ModesParameters((2500.0,), (0.01,), (-0.03,)),
        ModesParameters((2200.0, 4000.0), (0.017, 0.01), (0.05, -0.03)),
    ],
    ids=["none", "textbook", "opposite", "two"],
)
def test_as_many_modes_are_found_as_there_are(modes):
    measurement = measured(step(40.0, 800), np.zeros(800), modes)
    model = identify_dynamics(measurement, measurement.voltage, most_modes=5)
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=1e-4)
    assert model.damping_ratio == pytest.approx(DAMPING, rel=0.01)
    assert len(model.modes) == len(modes.share)
    for found, *expected in zip(model.modes, modes.frequency_hz, modes.damping, modes.share):
        frequency, damping, share = expected
        assert found.natural_frequency == pytest.approx(2.0 * np.pi * frequency, rel=1e-4)
        assert found.damping_ratio == pytest.approx(damping, rel=0.02)
        assert found.share == pytest.approx(share, rel=0.01)
    left = measurement.deflection - model.deflection(measurement.time, measurement.voltage)
    assert np.sqrt(np.mean(left**2)) < 8e-9  # noise of 5 nm, steps of 10 nm: 5.8 nm


@pytest.mark.parametrize("late", [0, 2])
@pytest.mark.parametrize("modes", [NONE, ModesParameters((4178.0,), (0.017,), (0.08,))])
@pytest.mark.parametrize("bandwidth_hz", [0.0, 200.0, 1000.0, 4000.0])
def test_the_lag_of_an_amplifier_is_told_from_hysteresis_damping_and_delay(
    bandwidth_hz, modes, late
):
    measurement = measured(step(40.0, 800), np.zeros(800), modes, bandwidth_hz)
    shifted = np.concatenate((np.zeros(late), measurement.deflection))[:800]
    static = partial(deflection_history, HysteresisParameters())
    model = identify_dynamics(
        replace(measurement, deflection=shifted), measurement.voltage, 3, static
    )
    assert model.bandwidth_hz == pytest.approx(bandwidth_hz, rel=2e-3)
    assert model.delay_samples(measurement.sample_time) == late
    assert len(model.modes) == len(modes.share)
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=1e-4)
    assert model.damping_ratio == pytest.approx(DAMPING, rel=0.01)
    if bandwidth_hz:
        half_width = model.confidence["amplifier.bandwidth_hz"]
        assert 0.0 < half_width < 2e-3 * bandwidth_hz
    left = shifted - model.deflection(measurement.time, measurement.voltage, static)
    assert np.sqrt(np.mean(left**2)) < 8e-9  # noise of 5 nm, steps of 10 nm: 5.8 nm


def test_creep_is_taken_for_no_mode():
    """Logarithmic creep of 4 % of the deflection in 80 ms, as no straight line says it."""
    measurement = measured(step(40.0, 800), np.zeros(800))
    since = np.maximum(measurement.time - 2e-3, 0.0)
    crept = measurement.deflection + 0.2e-6 * np.log1p(since / 1e-3)
    model = identify_dynamics(replace(measurement, deflection=crept), measurement.voltage, 5)
    assert model.modes == ()
    assert model.natural_frequency == pytest.approx(FREQUENCY, rel=1e-3)


def rung(sample_time, delay, sensor_hz=0.0, duration=0.1):
    """A step of 20 V at 2 ms of a finger with 700 Hz, damping ratio 0.02, 0.5 µm/V, through a late sensor; 5 nm noise.

    By scipy's step response in continuous time: a row's drive was held until its deflection, so the step's row
    is a sample after the step.
    """
    time = np.arange(0.0, duration, sample_time)
    omega = 2.0 * np.pi * 700.0
    system = [1.0], [omega**-2, 0.04 / omega, 1.0]
    if sensor_hz:
        system = [1.0], np.polymul(system[1], [1.0 / (2.0 * np.pi * sensor_hz), 1.0])
    begin = 2e-3
    after = time - begin - delay
    fine = np.linspace(0.0, duration, 100_001)
    deflection = np.interp(after, *step_response(system, T=fine), left=0.0) * 10e-6
    deflection += np.random.default_rng(4).normal(0.0, 5e-9, time.size)
    voltage = np.where(time > begin + 0.5 * sample_time, 20.0, 0.0)
    return Measurement("rung", time, voltage, deflection, None, None, np.arange(time.size))


@pytest.mark.parametrize(
    "sample_time, delay",
    [
        (1e-4, 25e-6),
        (1e-4, 137.5e-6),
        (1e-4, 262.5e-6),
        (2e-5, 100e-6),
        (5e-6, 100e-6),
        (5e-6, 47e-6),
    ],
)
def test_a_delay_between_samples_and_one_of_many_is_found_and_makes_no_modes(sample_time, delay):
    measurement = rung(sample_time, delay, duration=0.05)
    model = identify_dynamics(measurement, measurement.voltage, most_modes=3)
    assert model.modes == ()
    assert model.delay == pytest.approx(delay, abs=2e-7)
    assert model.natural_frequency == pytest.approx(2.0 * np.pi * 700.0, rel=1e-4)
    assert model.damping_ratio == pytest.approx(0.02, rel=2e-3)
    assert model.delay_samples(1e-4) == math.ceil(delay / 1e-4 - 0.2)


def test_a_filter_in_the_sensor_makes_no_modes():
    measurement = rung(1e-4, 0.0, sensor_hz=2e3)
    model = identify_dynamics(measurement, measurement.voltage, most_modes=3)
    assert model.modes == ()
    assert model.delay == pytest.approx(
        1.0 / (2.0 * np.pi * 2e3), rel=0.1
    )  # of a lag, at low frequencies
    assert model.natural_frequency == pytest.approx(2.0 * np.pi * 700.0, rel=1e-3)
    assert model.damping_ratio == pytest.approx(0.02, rel=0.1)
