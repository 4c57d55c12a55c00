# SPDX-License-Identifier: Apache-2.0
"""The composed plant: against an independent integration, and against the paper's figures."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, lfilter

from piezo_control.creep import CreepParameters
from piezo_control.dynamics import DynamicsParameters, ModesParameters
from piezo_control.hysteresis import Hysteresis
from piezo_control.parameters import ParameterError, build, load
from piezo_control.shared import shared_folder
from piezo_control.thermal import ThermalParameters
from piezo_sim.plant.amplifier import AmplifierParameters
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.plant.contact import ContactParameters
from piezo_sim.plant.sensor import SensorParameters

PERFECT = SensorParameters(resolution=0.0, noise=0.0, delay_samples=0)


def run(cantilever, voltages, temperatures, forces=None):
    """Return readings y_0 ... y_n of n inputs."""
    forces = np.zeros(len(voltages)) if forces is None else forces
    readings = [cantilever.measure()]
    for inputs in zip(voltages, np.broadcast_to(temperatures, len(voltages)), forces):
        cantilever.advance(*map(float, inputs))
        readings.append(cantilever.measure())
    return np.array(readings)


def test_equation_3_against_an_integration():
    """delta = H_s(U) D(s) + s_p F D(s) + g(T) + Creep(U, T) with every term at work."""
    thermal = ThermalParameters(gain_per_degc=0.0, lag_per_degc=0.0)
    steep = AmplifierParameters(slew_limit=1e6)  # every step within a sample
    parameters = CantileverParameters(sensor=PERFECT, thermal=thermal, amplifier=steep)
    voltages, temperatures, forces = [30.0, -20.0, 10.0], [22.0, 40.0, 30.0], [0.0, 1e-3, -2e-3]
    hold = 200  # samples, 20 ms each
    got = run(
        Cantilever(parameters),
        np.repeat(voltages, hold),
        np.repeat(temperatures, hold),
        np.repeat(forces, hold),
    )
    a2, a1, _ = DynamicsParameters().denominator
    creep = CreepParameters()
    static = Hysteresis(parameters.hysteresis)
    state = np.array([0.0, 0.0, 22.0, 0.0, 0.0, 0.0])
    expected = [0.0]
    for voltage, temperature, force in zip(voltages, temperatures, forces):
        target = static.step(voltage) + DynamicsParameters().elastic_constant * force

        def law(_, s, voltage=voltage, temperature=temperature, target=target):
            gain = creep.gain + creep.gain_per_degc * (s[2] - 22.0)
            pull = np.array(creep.shares) * gain * voltage - s[3:]
            body = (temperature - s[2]) / thermal.time_constant
            spring = (target - a1 * s[1] - s[0]) / a2
            return np.concatenate([[s[1], spring, body], pull / creep.times])

        path = solve_ivp(
            law, (0.0, 0.02), state, t_eval=np.arange(1, hold + 1) * 1e-4, method="DOP853",
            rtol=1e-11, atol=[1e-15, 1e-12, 1e-9, 1e-16, 1e-16, 1e-16],
        )  # fmt: skip
        state = path.y[:, -1]
        expected += (
            path.y[0] + thermal.sensitivity * (path.y[2] - 22.0) + path.y[3:].sum(axis=0)
        ).tolist()
    # All is exact but the creep's gain, which follows the body half a sample late:
    # h / 2 * warming * gain_per_degc * U * sum(shares / times) = 5e-5 * 1.2 * 1.2e-8 * 20 * 0.125 m.
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=3e-12)


def test_a_second_mode_and_the_amplifier_s_lag_against_scipy():
    """delta = H_s(U) ((1 - s) D_1 + s D_2) behind the lag, every mode sampled by scipy's exact hold."""
    shipped = load(
        shared_folder() / "params" / "finger_second_mode" / "cantilever.yaml", "cantilever"
    )
    parameters = build(CantileverParameters, shipped, "shipped")
    modes, h = parameters.modes, parameters.sample_time
    assert (modes.frequency_hz, modes.damping, modes.share) == ((4178.0,), (0.017,), (0.08,))
    perfect = dataclasses.replace(
        parameters,
        sensor=PERFECT,
        creep=CreepParameters(gain=0.0),
        amplifier=dataclasses.replace(parameters.amplifier, slew_limit=1e9),
    )
    demand = np.repeat([30.0, -20.0, 10.0], 150)
    got = run(Cantilever(perfect), demand, 22.0)
    left = np.exp(-2.0 * np.pi * 10000.0 * h)
    voltage = lfilter([1.0 - left], [1.0, -left], demand)
    static = Hysteresis(parameters.hysteresis)
    target = [static.step(float(v)) for v in voltage]
    w = 2.0 * np.pi * 4178.0
    expected = np.zeros(len(demand) + 1)
    for share, denominator in (
        (0.92, DynamicsParameters().denominator),
        (0.08, (1.0 / w**2, 0.034 / w, 1.0)),
    ):
        numerator, sampled, _ = cont2discrete(([share], denominator), h, "zoh")
        expected += lfilter(numerator[0], sampled, [*target, 0.0])
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=1e-12)
    one_mode = run(Cantilever(dataclasses.replace(perfect, modes=ModesParameters())), demand, 22.0)
    assert np.max(np.abs(one_mode - got)) > 1e-6


@pytest.mark.parametrize(
    "values, told",
    [
        ({"share": (0.1,)}, "0, 0 and 1 elements, must have equally many"),
        ({"frequency_hz": (4e3, 9e3), "damping": (0.1, 0.1), "share": (0.6, 0.6)}, "a sum below 1"),
    ],
)
def test_modes_that_make_no_finger_are_refused(values, told):
    with pytest.raises(ParameterError, match=told):
        ModesParameters(**values)


def test_first_reading_is_zero_and_rest_stays_at_rest_at_any_temperature():
    for temperature in (22.0, 32.0):
        cantilever = Cantilever(CantileverParameters(sensor=PERFECT))
        assert np.max(np.abs(run(cantilever, np.zeros(1000), temperature))) == 0.0


@pytest.mark.parametrize("plant", ["prandtl_ishlinskii", "truth"])
def test_a_finger_with_a_bias_begins_at_rest_with_every_mode(plant):
    parameters = CantileverParameters(
        plant=plant,
        sensor=PERFECT,
        amplifier=AmplifierParameters(voltage_low=0.0, voltage_high=60.0, rest_voltage=20.0),
        modes=ModesParameters(frequency_hz=(4178.0,), damping=(0.017,), share=(0.08,)),
    )
    readings = run(Cantilever(parameters), np.full(200, 20.0), 22.0)
    # 20 ms later only creep has moved it: 0.1 % of the stroke here.
    assert readings == pytest.approx(readings[0], abs=0.1e-6)
    if plant != "truth":  # sum_i w_i max(20 V - r_i, 0) of the default weights and thresholds
        assert readings[0] == pytest.approx(9.151e-6, rel=1e-9)


def test_warming_by_10_degrees_moves_the_free_tip_by_g():
    cantilever = Cantilever(CantileverParameters(sensor=PERFECT))
    temperatures = np.concatenate([np.full(10, 22.0), np.full(30000, 32.0)])
    readings = run(cantilever, np.zeros(30010), temperatures)
    assert readings[-1] == pytest.approx(10 * ThermalParameters().sensitivity, rel=1e-4)
    assert readings[10 + 3000] == pytest.approx(1.5e-6 * (1 - np.exp(-1)), rel=1e-3)  # 0.3 s


@pytest.mark.parametrize("plant", ["prandtl_ishlinskii", "truth"])
@pytest.mark.parametrize("temperature", [22.0, 32.0])
def test_figure_5_loop(plant, temperature):
    """1 Hz, ±40 V: about ±22 µm; the loop hardly moves with temperature."""
    parameters = CantileverParameters(plant=plant, sample_time=1e-3, sensor=PERFECT)
    voltage = 40.0 * np.sin(2.0 * np.pi * np.arange(1, 3001) * 1e-3)
    loop = run(Cantilever(parameters), voltage, temperature)[2001:]
    assert np.max(loop) == pytest.approx(22e-6, rel=0.08)
    assert np.min(loop) == pytest.approx(-22e-6, rel=0.08)
    width = (loop[499] - loop[999]) / np.ptp(loop)
    assert 0.15 <= width <= (0.20 if temperature == 22.0 else 0.22)


@pytest.mark.parametrize("plant", ["prandtl_ishlinskii", "truth"])
def test_figure_4_creep_is_negligible_at_22_and_large_at_32_degrees(plant):
    """40 V for 300 s; negligible: within the thickness of a line in the figure, 5 % of the step."""
    parameters = CantileverParameters(plant=plant, sample_time=0.1, sensor=PERFECT)
    drift = {}
    for temperature in (22.0, 32.0):
        readings = run(Cantilever(parameters), np.full(3000, 40.0), temperature)
        drift[temperature] = readings[-1] - readings[1]
    assert 0.0 < drift[22.0] < 0.05 * 22e-6
    assert 3e-6 < drift[32.0] < 8e-6


@pytest.mark.parametrize("temperature, slope", [(22.0, (0.99, 1.01)), (32.0, (1.03, 1.07))])
def test_figure_9_slope_of_the_compensated_actuator(temperature, slope):
    """The fixed inverse gives slope 1 at 22 °C and a visibly different one at 32 °C."""
    parameters = CantileverParameters(sample_time=1e-3, sensor=PERFECT)
    inverse = Hysteresis(parameters.hysteresis).inverse()
    reference = 20e-6 * np.sin(2.0 * np.pi * np.arange(1, 3001) * 1e-3)
    readings = run(Cantilever(parameters), inverse(reference), temperature)[1:]
    assert slope[0] <= np.polyfit(reference[2000:], readings[2000:], 1)[0] <= slope[1]


def test_contact_force_joins_the_external_force():
    contact = ContactParameters(stiffness=1000.0, damping=0.1, free_play=5e-6)
    cantilever = Cantilever(CantileverParameters(contact=contact, sensor=PERFECT))
    run(cantilever, np.full(5000, 40.0), 22.0, np.full(5000, 1e-3))
    expected = 1e-3 - 1000.0 * (cantilever.deflection - 5e-6)
    assert cantilever.tip_force == pytest.approx(expected, rel=1e-6)
    assert 5e-6 < cantilever.deflection < 22e-6


@pytest.mark.parametrize("name, unit", [("voltage", "V"), ("temperature_degc", "°C")])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_refused_and_changes_nothing(name, unit, value):
    cantilever = Cantilever(CantileverParameters())
    cantilever.advance(10.0, 22.0)
    before = cantilever.measure(), cantilever.deflection, cantilever.voltage, cantilever.samples
    inputs = {"voltage": 1.0, "temperature_degc": 22.0, name: value}
    with pytest.raises(ValueError, match=f"{name} is {value} {unit} at sample 1"):
        cantilever.advance(**inputs)
    after = cantilever.measure(), cantilever.deflection, cantilever.voltage, cantilever.samples
    assert after == before


NOISY = CantileverParameters(sensor=SensorParameters(dropout_rate=0.1, delay_samples=3))


def test_reset_repeats_a_run_and_another_seed_does_not():
    voltages = 30.0 * np.sin(np.arange(500) * 0.05)
    cantilever = Cantilever(NOISY)
    first = run(cantilever, voltages, 22.0)
    cantilever.reset()
    assert (run(cantilever, voltages, 22.0) == first).all()
    other = Cantilever(dataclasses.replace(NOISY, seed=2))
    assert (run(other, voltages, 22.0) != first).any()
