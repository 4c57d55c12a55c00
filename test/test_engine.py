# SPDX-License-Identifier: Apache-2.0
"""The engine against the laws called one by one, as the nodes do, and its own bookkeeping."""

import dataclasses
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from piezo_control.compiled import compiled
from piezo_control.feedback import Feedback, FeedbackParameters
from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.parameters import ParameterError, build, load
from piezo_control.profile import Profile
from piezo_sim import engine
from piezo_sim.plant.cantilever import Cantilever, CantileverParameters
from piezo_sim.plant.contact import ContactParameters
from piezo_sim.plant.sensor import SensorParameters
from piezo_sim.temperature import TemperatureParameters, temperature

PARAMS = Path(__file__).parent.parent / "params"
PAPER = build(FeedbackParameters, load(PARAMS / "feedback_paper.yaml", "feedback"))
OPEN_LOOP = FeedbackParameters()
PLANT = CantileverParameters(
    sensor=SensorParameters(dropout_rate=0.05, delay_samples=2),
    contact=ContactParameters(stiffness=300.0, damping=0.05, free_play=12e-6),
)
REFERENCE = Profile([0.0, 0.01, 0.05], [0.0, 30e-6, -5e-6], linear=True)  # beyond the reach, too
FORCE = Profile([0.0, 0.03], [0.0, 1e-3])
TEMPERATURES = TemperatureParameters(profile="sine", frequency_hz=5.0)
SAMPLES = 800


def node_by_node(plant, feedforward, feedback):
    """Return readings, commands and voltages of the loop over the classes that the nodes use."""
    cantilever = Cantilever(plant)
    inverse = Feedforward(feedforward, plant.sample_time)
    controller = Feedback(feedback)
    degc = temperature(TEMPERATURES, 0, SAMPLES)
    rows = []
    for k in range(SAMPLES):
        instant = k * plant.sample_time
        deflection = cantilever.measure()
        command = controller.step(float(REFERENCE.at(instant)), deflection)
        voltage = inverse.step(command)
        rows.append((deflection, command, voltage, cantilever.deflection, cantilever.tip_force))
        cantilever.advance(voltage, float(degc[k // 10]), float(FORCE.at(instant)))
    return np.array(rows).T, inverse.clipped + cantilever.clipped


needs_numba = pytest.mark.skipif(
    importlib.util.find_spec("numba") is None, reason="numba is not installed"
)


@pytest.mark.parametrize("plant", ["prandtl_ishlinskii", "truth"])
@pytest.mark.parametrize("feedback", [PAPER, OPEN_LOOP], ids=["closed", "open"])
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_numba)])
def test_samples_are_those_of_the_laws_one_by_one(plant, feedback, compiled):
    plant = dataclasses.replace(PLANT, plant=plant)
    expected, clipped = node_by_node(plant, FeedforwardParameters(), feedback)
    got = engine.run(
        plant, FeedforwardParameters(), feedback, TEMPERATURES, REFERENCE, SAMPLES, FORCE,
        compiled=compiled,
    )  # fmt: skip
    names = ("deflection", "command", "voltage", "true_deflection", "total_force")
    for name, signal, tolerance in zip(names, expected, (1e-12, 1e-12, 1e-6, 1e-12, 1e-9)):
        np.testing.assert_allclose(getattr(got, name), signal, rtol=0.0, atol=tolerance)
    assert got.clipped == clipped
    assert np.ptp(got.total_force) > 1e-3  # the object was touched, so contact was compared too


def run(samples=500, **changes):
    arguments = {
        "plant": PLANT,
        "feedforward": FeedforwardParameters(),
        "feedback": PAPER,
        "temperatures": TEMPERATURES,
        "reference": REFERENCE,
        "samples": samples,
    }
    return engine.run(**(arguments | changes))


def test_samples_do_not_depend_on_how_they_are_grouped(monkeypatch):
    expected = run()
    monkeypatch.setattr(engine, "AT_ONCE", 37)
    got = run()
    for field in dataclasses.fields(engine.Run):
        assert np.array_equal(getattr(got, field.name), getattr(expected, field.name))


@pytest.mark.parametrize("every", [2, 7, 600])
def test_every_nth_sample_is_taken_down(every):
    all_of_them, some = run(), run(every=every)
    for field in dataclasses.fields(engine.Run)[:-1]:
        expected = getattr(all_of_them, field.name)[::every]
        assert np.array_equal(getattr(some, field.name), expected), field.name


def test_drive_applies_the_voltage_to_the_bare_cantilever():
    voltage = Profile([0.0, 0.1], [0.0, 45.0], linear=True)
    got = engine.drive(PLANT, TEMPERATURES, voltage, 1000)
    expected = np.minimum(voltage.at(got.time), 40.0)
    np.testing.assert_allclose(got.voltage, expected, rtol=0.0, atol=1e-12)
    cantilever = Cantilever(PLANT)
    degc = temperature(TEMPERATURES, 0, 100)
    for k, volts in enumerate(expected[:999].tolist()):
        cantilever.advance(volts, float(degc[k // 10]))
    assert got.true_deflection[999] == pytest.approx(cantilever.deflection, abs=1e-12)


def test_sample_times_that_differ_are_refused():
    with pytest.raises(ParameterError, match="feedback 'sample_time' is 0.0001 s.* 0.001 s"):
        run(plant=CantileverParameters(sample_time=1e-3))


def test_no_samples_are_refused():
    with pytest.raises(ValueError, match="samples is 0"):
        run(samples=0)


@needs_numba
def test_one_machine_code_serves_every_finger():
    run()
    run(plant=CantileverParameters(plant="truth"), feedback=OPEN_LOOP)
    assert len(compiled(engine.run_samples).signatures) == 1


def test_importing_the_engine_does_not_import_the_compiler():
    program = "import sys, piezo_sim.engine; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
