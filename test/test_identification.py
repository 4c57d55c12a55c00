# SPDX-License-Identifier: Apache-2.0
"""Hysteresis from recordings: known weights come back, and a measured actuator is described."""

import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from piezo_control.creep import CreepParameters
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification.excitation import decaying_sine
from piezo_control.identification.fit import quality
from piezo_control.identification.hysteresis import (
    equal_thresholds,
    identify_hysteresis,
    settled,
)
from piezo_control.identification.measurement import Measurement, MeasurementError, read_measurement
from piezo_control.parameters import ParameterError
from piezo_sim.engine import drive
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.temperature import TemperatureParameters

P885 = Path(__file__).parent / "data" / "p885_hysteresis" / "Model_Vi_Do.dat"
SETTLED = slice(400, None)


def recorded(parameters, sample_time, lag=0.0, offset=0.0):
    """A decaying excitation seen by the paper's sensor: 10 nm steps and 5 nm of noise."""
    profile = decaying_sine(40.0, cycles=20)
    time = np.arange(0.0, profile.time[-1], sample_time)
    deflection = deflection_history(parameters, profile.at(time - lag)) + offset
    noise = 5e-9 * np.random.default_rng(5).standard_normal(len(time))
    readings = 10e-9 * np.round((deflection + noise) / 10e-9)
    return Measurement("sim", time, profile.at(time), readings, None, None, np.arange(len(time)))


@pytest.fixture(scope="module")
def p885():
    return read_measurement(P885, {"voltage": "0", "deflection": "4:um"}, sample_time=0.005)


def fit_percent(model, measurement, samples):
    modelled = model.deflection(measurement.time, measurement.voltage)
    return quality(measurement.deflection[samples], modelled[samples]).rms_percent


def test_weights_come_back_within_1_percent():
    truth = HysteresisParameters()
    model = identify_hysteresis(recorded(truth, 1e-3), truth.thresholds, lag=0.0)
    np.testing.assert_allclose(model.parameters.weights, truth.weights, rtol=0.01)
    assert abs(model.offset) < 5e-9


def test_weights_come_back_from_a_vibrating_finger():
    """The whole finger but its creep: resonance, sensor delay, noise and 10 nm steps, at 10 kHz.

    The resonance smooths the held voltages, so the deflection is half a sample ahead of the pairing.
    """
    plant = CantileverParameters(creep=CreepParameters(gain=0.0))
    constant = TemperatureParameters(profile="constant", base_degc=22.0)
    run = drive(plant, constant, decaying_sine(40.0, cycles=20), 200_000)
    voltage = np.concatenate(([0.0, 0.0], run.voltage))[: len(run.time)]
    measurement = Measurement("sim", run.time, voltage, run.deflection, None, None, run.number)
    lag = -0.5 * plant.sample_time
    model = identify_hysteresis(measurement, plant.hysteresis.thresholds, lag=lag)
    np.testing.assert_allclose(model.parameters.weights, plant.hysteresis.weights, rtol=0.01)


@pytest.mark.parametrize("share", [0.1, 0.45, 1.0])
def test_a_virgin_share_is_found_back_from_a_recording_that_begins_at_rest(share):
    truth = replace(HysteresisParameters(), virgin_share=share)
    model = identify_hysteresis(recorded(truth, 1e-3, offset=3e-6), truth.thresholds, lag=0.0)
    half = model.confidence["hysteresis.virgin_share"]
    assert half < 0.01
    assert model.parameters.virgin_share == pytest.approx(share, abs=0.01)
    # The loops are identified from later rows, of which none depends on it.
    np.testing.assert_allclose(model.parameters.weights, truth.weights, rtol=0.01)


def test_no_virgin_share_is_found_where_nothing_tells_of_it():
    """A finger whose plays are at 0, one that was in use, and a recording that begins elsewhere."""
    truth = HysteresisParameters()
    whole = recorded(truth, 1e-3)
    profile = decaying_sine(40.0, cycles=20)
    used = deflection_history(truth, np.concatenate(([40.0], profile.at(whole.time))))[1:]
    virgin = replace(truth, virgin_share=0.45)
    for measurement, why in (
        (whole, "not told from 0"),
        (replace(whole, deflection=used), r"begins [\d.]+ µm beside the rest of its later loops"),
        (recorded(virgin, 1e-3).part(slice(60, None)), "does not begin at 0 V"),
    ):
        model = identify_hysteresis(measurement, truth.thresholds, lag=0.0)
        assert model.parameters.virgin_share == 0.0
        assert re.search(why, model.untold), model.untold


def test_lag_and_offset_are_told_from_the_hysteresis():
    truth = HysteresisParameters()
    measurement = recorded(truth, 1e-3, lag=8e-3, offset=-120e-6)
    model = identify_hysteresis(measurement, truth.thresholds)
    assert model.lag == pytest.approx(8e-3, abs=0.2e-3)
    assert model.offset == pytest.approx(-120e-6, abs=20e-9)
    np.testing.assert_allclose(model.parameters.weights[:6], truth.weights[:6], rtol=0.1)


def test_no_lag_is_found_where_there_is_none():
    truth = HysteresisParameters()
    assert identify_hysteresis(recorded(truth, 1e-3), truth.thresholds).lag == 0.0


def stack(phase, lag=0.0, spikes=()):
    """A stack of 0 to 150 V, 1 kHz, 5 nm of noise, between thresholds that are none of the fit's equal ones."""
    time = np.arange(len(phase)) * 1e-3
    voltage = 75.0 * (1.0 - phase)
    operator = HysteresisParameters(
        (0.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0),
        (6e-8, 1.2e-8, 1e-8, 8e-9, 6e-9, 5e-9, 4e-9),
    )
    late = np.interp(time - lag, time, deflection_history(operator, voltage))
    readings = late + 5e-9 * np.random.default_rng(13).standard_normal(len(time))
    readings[list(spikes)] += 5e-6
    return Measurement("stack", time, voltage, readings, None, None, np.arange(len(time)))


COSINE = np.cos(2e-3 * np.pi * np.arange(10_000))
TRIANGLE = 2.0 * np.abs(np.arange(4000) / 1000.0 % 2.0 - 1.0) - 1.0
SINE = 1.0 - np.sin(2e-3 * np.pi * np.arange(8000)) * np.linspace(1.0, 0.1, 8000)


@pytest.mark.parametrize(
    ("phase", "spikes"),
    [(COSINE, ()), (TRIANGLE, ()), (SINE, (1501, 2501, 3334, 4445))],
    ids=["one amplitude", "triangle", "spikes"],
)
def test_means_between_two_rows_are_not_taken_for_a_lag(phase, spikes):
    """They halve the noise, or fewer rows miss a spike; here nothing lags."""
    measurement = stack(phase, spikes=spikes)
    assert identify_hysteresis(measurement, equal_thresholds(measurement, 20), 3).lag == 0.0


@pytest.mark.parametrize("lag", [1e-3, 3e-3, 8e-3])
def test_the_interval_of_a_lag_holds_it(lag):
    measurement = stack(COSINE, lag)
    model = identify_hysteresis(measurement, equal_thresholds(measurement, 20), 3)
    assert model.lag == pytest.approx(lag, abs=model.confidence["lag"])
    assert model.confidence["lag"] < 0.6e-3


def test_three_hundred_thresholds_take_seconds():
    """Bounded least squares used to take minutes of a processor for them; they leave no more than the noise, 5 nm."""
    measurement = stack(SINE)
    begin = time.process_time()
    model = identify_hysteresis(measurement, equal_thresholds(measurement, 300), 3)
    assert time.process_time() - begin < 20.0
    fitted = slice(settled(measurement), None)
    modelled = model.deflection(measurement.time, measurement.voltage)
    assert quality(measurement.deflection[fitted], modelled[fitted]).rms < 5.5e-9


def test_dead_zones_come_back_where_the_fit_has_its_knots():
    """One on either side: the fit bends a quarter of the stroke from the middle, a = (e + p (e - a)) / 2."""
    end, change = 22e-6, 0.2
    knot = (1.0 + change) / (2.0 + change) * end
    truth = HysteresisParameters(
        upper_thresholds=(knot,), upper_weights=(change,),
        lower_thresholds=(knot,), lower_weights=(change,),
    )  # fmt: skip
    measurement = recorded(truth, 1e-3)
    fit = identify_hysteresis(measurement, truth.thresholds, dead_zones=1, lag=0.0, first=0)
    model = fit.parameters
    np.testing.assert_allclose([model.upper_thresholds, model.lower_thresholds], knot, rtol=0.01)
    np.testing.assert_allclose([model.upper_weights, model.lower_weights], change, rtol=0.02)


def test_measured_actuator_classical(p885):
    model = identify_hysteresis(p885, equal_thresholds(p885, 10), first=400)
    assert fit_percent(model, p885, SETTLED) <= 0.90


def test_measured_actuator_modified(p885):
    model = identify_hysteresis(p885, equal_thresholds(p885, 20), dead_zones=3, first=400)
    assert fit_percent(model, p885, SETTLED) <= 0.50
    assert model.lag == pytest.approx(0.018, abs=0.002)  # the turning points lag by 3 to 4 rows


@pytest.mark.parametrize("dead_zones", [0, 3])
def test_measured_actuator_held_back(p885, dead_zones):
    """Fitted on the first 60 % of the cycles, judged on the rest with the offset of the first."""
    split = 400 + 23 * 200
    thresholds = equal_thresholds(p885, 20)
    model = identify_hysteresis(p885, thresholds, dead_zones, first=400, last=split)
    assert fit_percent(model, p885, slice(split, None)) <= (0.95 if dead_zones == 0 else 0.7)


def test_feedforward_identified_from_a_plant_of_another_class():
    """Excite the Bouc-Wen plant, identify, invert: 1 Hz, +-20 um within 2.5 % of the stroke."""
    sample_time, delay = 2e-3, 1

    def finger():
        return Cantilever(CantileverParameters(plant="truth", sample_time=sample_time))

    def tracked(law):
        plant = finger()
        deflection = []
        for command in reference.tolist():
            plant.advance(law.step(command), 22.0)
            deflection.append(plant.deflection)
        error = np.abs(np.array(deflection) - reference)
        return 100.0 * error[error.size // 3 :].max() / 40e-6  # after the first of three cycles

    plant, deflection = finger(), []
    time = np.arange(0.0, 20.0, sample_time)
    voltage = decaying_sine(40.0, cycles=20).at(time)
    for v in voltage.tolist():
        deflection.append(plant.measure())
        plant.advance(v, 22.0)
    seen = np.concatenate((np.zeros(1 + delay), voltage))[: len(time)]
    measurement = Measurement(
        "truth", time, seen, np.array(deflection), None, None, np.arange(len(time))
    )
    model = identify_hysteresis(measurement, equal_thresholds(measurement, 20), 3, lag=0.0)

    reference = 20e-6 * np.sin(2.0 * np.pi * np.arange(0.0, 3.0, sample_time))
    stands = {"voltage_low": -45.0, "voltage_high": 45.0, "slew_limit": 1e6}
    inverse = FeedforwardParameters(hysteresis=model.parameters, **stands)
    straight = FeedforwardParameters(
        compensator="static_gain", static_gain=np.ptp(deflection) / 80.0, **stands
    )
    assert tracked(Feedforward(inverse, sample_time)) <= 2.5
    assert tracked(Feedforward(straight, sample_time)) > 7.0


def test_fit_begins_where_the_plays_are_known():
    time = np.arange(400) * 0.01
    voltage = 10.0 * np.sin(2.0 * np.pi * time)
    measurement = Measurement("sine", time, voltage, voltage, None, None, np.arange(400))
    assert settled(measurement) == pytest.approx(75, abs=3)  # three quarters of the first cycle


@pytest.mark.parametrize(
    ("thresholds", "error", "message"),
    [
        ((0.0, 1.0, 2.0), MeasurementError, "threshold 2 V never comes into play"),
        ((0.0, 1.0, 1.0), ParameterError, r"'thresholds\[2\]'"),
        ((0.5, 1.0), ParameterError, "must start with 0.0 V"),
    ],
)
def test_unusable_thresholds_are_refused(p885, thresholds, error, message):
    with pytest.raises(error, match=message):
        identify_hysteresis(p885, thresholds)


def test_too_little_data_is_refused(p885):
    with pytest.raises(MeasurementError, match="100 samples are left to fit 22 numbers"):
        identify_hysteresis(p885, equal_thresholds(p885, 20), first=400, last=500)


def test_a_deflection_that_does_not_move_where_it_is_fitted_is_refused():
    time = np.arange(400) * 0.01
    step = np.where(time < 1.0, 0.0, 10.0)
    measurement = Measurement("step", time, step, step, None, None, np.arange(400))
    with pytest.raises(MeasurementError, match="'voltage' is 10 in all rows 100 to 399"):
        identify_hysteresis(measurement, (0.0, 1.0), lag=0.0)
