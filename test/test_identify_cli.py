# SPDX-License-Identifier: Apache-2.0
"""The command line: from bags and text files to parameters that linearise the finger they came from."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from piezo_control.creep import CreepParameters
from piezo_control.dynamics import ModesParameters
from piezo_control.feedback import FeedbackParameters
from piezo_control.feedforward import FeedforwardParameters
from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification.cli import main
from piezo_control.identification.dynamics import DynamicsModel
from piezo_control.identification.excitation import decaying_sine
from piezo_control.nodes.parameters import (
    FeedforwardNodeParameters,
    ServoNodeParameters,
    read_feedforward,
)
from piezo_control.parameters import build, dump, load
from piezo_control.profile import Profile
from piezo_control.recording.writer import write_recording
from piezo_sim.engine import drive, run
from piezo_sim.experiment import cli as experiment
from piezo_sim.plant.amplifier import AmplifierParameters
from piezo_sim.plant.cantilever import CantileverParameters
from piezo_sim.temperature import TemperatureParameters

P885 = Path(__file__).parent / "data" / "p885_hysteresis" / "Model_Vi_Do.dat"
P885_COLUMNS = ("--voltage", "0", "--deflection", "4:um", "--sample-rate", "200", "--skip", "400")
CONSTANT = TemperatureParameters(profile="constant", base_degc=22.0)
ZERO = Profile([0.0], [0.0])


@pytest.fixture
def identify(monkeypatch, tmp_path):
    """Run the command line with results in a folder of the test; return its exit code."""

    def call(*arguments):
        command = ["identify", *map(str, arguments), "--out", str(tmp_path / "identified")]
        monkeypatch.setattr(sys, "argv", command)
        return main()

    return call


def recorded(bag, plant, voltage, duration, tip_force=ZERO):
    """Drive the cantilever in the engine and write what the recorder would have written."""
    samples = round(duration / plant.sample_time)
    result = drive(plant, CONSTANT, voltage, samples, tip_force=tip_force)
    write_recording(bag, "finger", result, voltage, tip_force)
    return bag


def largest_error(plant, feedforward):
    """Return how far (% of the stroke) the finger is from 1 Hz, +-20 µm, after the first of three cycles."""
    time = np.arange(3001) * 1e-3
    reference = Profile(time, 20e-6 * np.sin(2.0 * np.pi * time), linear=True)
    result = run(plant, feedforward, FeedbackParameters(), CONSTANT, reference, 3000)
    error = np.abs(result.true_deflection - np.roll(result.reference, 1))
    return 100.0 * error[1000:].max() / 40e-6


def test_excite_identify_linearise_a_plant_of_another_class(identify, tmp_path):
    """The whole chain: the loaded parameters keep 1 Hz, +-20 um within 2.5 % of the stroke."""
    plant = CantileverParameters(plant="truth", sample_time=1e-3)
    bag = recorded(tmp_path / "excite", plant, decaying_sine(40.0, cycles=20), 20.0)
    assert identify("hysteresis", bag) == 0
    path = tmp_path / "identified" / "feedforward.yaml"
    identified = build(FeedforwardParameters, load(path, "feedforward"), str(path))
    assert largest_error(plant, identified) <= 2.5
    straight = FeedforwardParameters(compensator="static_gain", static_gain=identified.static_gain)
    assert largest_error(plant, straight) > 7.0


def spreadsheet(path, result):
    """Write a run as a German spreadsheet saves it: each deflection beside the voltage that it follows."""
    before = (
        2  # samples: the sensor's delay, and that a voltage is held from one sample to the next
    )
    rows = zip(result.time[before:], result.voltage[:-before], 1e6 * result.deflection[before:])
    lines = ["Messung 3;;", "Zeit (s);Spannung (V);Auslenkung (µm)"]
    lines += [
        f"{t - result.time[before]:.5f};{v:.5f};{d:.4f}".replace(".", ",") for t, v, d in rows
    ]
    path.write_bytes(("\r\n".join(lines) + "\r\n").encode("cp1252"))
    return path


def test_the_same_chain_from_a_spreadsheet(identify, monkeypatch, tmp_path):
    """Excite, identify hysteresis and dynamics of two tables, run an experiment with what was found."""
    slow = CantileverParameters(plant="truth", sample_time=1e-3)
    quick = CantileverParameters(plant="truth")
    words = ("--time", "Zeit", "--voltage", "Spannung", "--deflection", "Auslenkung")
    excited = drive(slow, CONSTANT, decaying_sine(40.0, cycles=20), 20_000)
    stepped = drive(quick, CONSTANT, Profile([0.0, 2e-3], [0.0, 40.0]), 800)  # with 0.2 % of creep
    assert identify("hysteresis", spreadsheet(tmp_path / "excite.csv", excited), *words) == 0
    assert identify("dynamics", spreadsheet(tmp_path / "step.csv", stepped), *words) == 0
    out = tmp_path / "identified"
    path = out / "feedforward.yaml"
    assert largest_error(slow, build(FeedforwardNodeParameters, load(path, "feedforward"))) <= 2.5
    found = build(CantileverParameters, load(out / "cantilever.yaml", "cantilever"))
    np.testing.assert_allclose(found.dynamics.denominator, (5.7e-8, 8.1e-6, 1.0), rtol=0.1)
    command = ["experiment", "feedforward", "--engine", "--plant", "truth", "--params", str(out)]
    monkeypatch.setattr(sys, "argv", [*command, "--out", str(tmp_path / "verified")])
    assert experiment.main() == 0
    rows = json.loads((tmp_path / "verified" / "metrics.json").read_text())
    assert rows


def test_what_drift_and_dynamics_find_joins_the_feedforward_of_node_and_servo(identify, tmp_path):
    plant = CantileverParameters(sample_time=1e-3)
    loops, bags = [], []
    for degc in (22.0, 32.0):
        temperatures = TemperatureParameters(base_degc=degc)
        for name, voltage, duration in (
            ("loop", decaying_sine(40.0, cycles=5), 5.0),
            ("creep", Profile([0.0, 1.0], [0.0, 40.0]), 60.0),
        ):
            bag = tmp_path / f"{name}_{degc:g}"
            samples = round(duration / plant.sample_time)
            write_recording(bag, "f", drive(plant, temperatures, voltage, samples), voltage, ZERO)
            (loops if name == "loop" else bags).append(bag)
    stepped = recorded(
        tmp_path / "step", CantileverParameters(), Profile([0.0, 2e-3], [0.0, 40.0]), 0.08
    )
    assert identify("hysteresis", loops[0], "--model", "classical", "--plays", "10") == 0
    path = tmp_path / "identified" / "feedforward.yaml"
    before = load(path, "feedforward")
    assert identify("dynamics", stepped) == 0
    assert identify("drift", *bags, *loops) == 0
    after = load(path, "feedforward")
    assert before.keys() < after.keys()
    # Creep is no longer in the operator: at 22 °C 0.3 µm of 22 µm come in minutes, a third within the loop.
    outer, whole = (sum(values["hysteresis.weights"]) for values in (after, before))
    assert 0.98 * whole < outer < whole
    models = build(FeedforwardNodeParameters, after, str(path))
    # Of creep nobody knows more than what came within a minute.
    found, expected = (
        creep.gain_per_degc * -np.dot(creep.shares, np.expm1(-50.0 / np.array(creep.times)))
        for creep in (models.creep, plant.creep)
    )
    assert found == pytest.approx(expected, rel=0.05)
    assert after["thermal.lag_per_degc"] == pytest.approx(plant.thermal.lag_per_degc, rel=0.1)
    assert after["thermal.gain_per_degc"] == pytest.approx(plant.thermal.gain_per_degc, rel=0.1)
    assert models.dynamics.denominator == pytest.approx(plant.dynamics.denominator, rel=0.01)
    servo = read_feedforward(ServoNodeParameters(feedforward_file=str(path)))
    assert servo.hysteresis == models.hysteresis


def test_loops_that_the_operator_describes_badly_tell_of_heat_by_their_difference(
    identify, tmp_path
):
    """They count by what changes from one temperature to the other, and so they are judged."""
    plant = CantileverParameters(plant="truth", sample_time=1e-2)
    bags = []
    for degc in (22.0, 32.0):
        temperatures = TemperatureParameters(base_degc=degc)
        for name, voltage, duration in (
            ("loop", decaying_sine(40.0, cycles=5, frequency_hz=0.5), 10.0),
            ("creep", Profile([0.0, 1.0], [0.0, 40.0]), 60.0),
        ):
            bags.append(tmp_path / f"{name}_{degc:g}")
            samples = round(duration / plant.sample_time)
            made = drive(plant, temperatures, voltage, samples)
            write_recording(bags[-1], "f", made, voltage, ZERO)
    assert identify("drift", *bags) == 0
    fits = json.loads((tmp_path / "identified" / "drift.json").read_text())["fits"]
    assert f"{bags[2]} less {bags[0].name}" in fits
    assert max(fit["rms_percent"] for fit in fits.values()) < 0.5


def test_every_step_ends_in_one_cantilever_file(identify, tmp_path):
    """Hysteresis, D(s) and elastic constant of the default finger, each from a bag of its own."""
    quick = CantileverParameters()
    slow = replace(quick, sample_time=1e-3, creep=CreepParameters(gain=0.0))
    excited = recorded(tmp_path / "excite", slow, decaying_sine(40.0, cycles=20), 20.0)
    stepped = recorded(tmp_path / "step", quick, Profile([0.0, 2e-3], [0.0, 40.0]), 0.08)
    pushed = recorded(tmp_path / "push", quick, ZERO, 0.1, Profile([0.0, 2e-3], [0.0, 1e-3]))
    thresholds = ",".join(map(str, quick.hysteresis.thresholds))
    assert identify("hysteresis", excited, "--model", "classical", "--thresholds", thresholds) == 0
    assert identify("dynamics", stepped) == 0
    assert identify("stiffness", pushed) == 0

    out = tmp_path / "identified"
    path = out / "cantilever.yaml"
    found = build(CantileverParameters, load(path, "cantilever"), str(path))
    np.testing.assert_allclose(found.hysteresis.weights, quick.hysteresis.weights, rtol=0.02)
    assert found.dynamics.denominator == pytest.approx(quick.dynamics.denominator, rel=0.01)
    assert found.dynamics.elastic_constant == pytest.approx(3.1e-3, rel=0.005)
    assert found.creep == quick.creep
    comments = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert [word in "\n".join(comments) for word in ("excite", "step", "push")] == [True] * 3
    intervals = {line.split(": ")[1]: line for line in comments if " ± " in line}
    assert {"hysteresis.weights", "natural_frequency_hz", "denominator", "elastic_constant"} <= (
        set(intervals)
    )
    frequency, width = map(float, intervals["natural_frequency_hz"].split(": ")[2].split(" ± "))
    assert frequency == pytest.approx(666.627, abs=width + 0.01) and 0.0 < width < 0.1
    before = sorted(path.read_text().splitlines())
    assert identify("dynamics", stepped) == 0  # takes the place of what it found before
    assert sorted(path.read_text().splitlines()) == before
    for picture in ("hysteresis.png", "dynamics.png", "stiffness.png"):
        assert (out / picture).stat().st_size > 10_000


def test_higher_modes_are_written_and_taken_back(identify, tmp_path):
    modes = ModesParameters((4178.0,), (0.017,), (0.08,))
    for number, plant in enumerate((CantileverParameters(modes=modes), CantileverParameters())):
        step = Profile([0.0, 2e-3], [0.0, 40.0])
        assert identify("dynamics", recorded(tmp_path / str(number), plant, step, 0.08)) == 0
        path = tmp_path / "identified" / "cantilever.yaml"
        found = build(CantileverParameters, load(path, "cantilever"), str(path)).modes
        for name in ("frequency_hz", "damping", "share"):
            assert getattr(found, name) == pytest.approx(getattr(plant.modes, name), rel=0.02)
    assert "modes:" not in path.read_text()


def test_creep_and_heat_from_two_bags(identify, tmp_path):
    plant = CantileverParameters(sample_time=2e-2)
    step = Profile([0.0, 1.0], [0.0, 40.0])
    bags = []
    for degc in (22.0, 32.0):
        temperatures = TemperatureParameters(profile="constant", base_degc=degc)
        bags.append(tmp_path / f"creep_{degc:g}")
        result = drive(plant, temperatures, step, 15_000)
        write_recording(bags[-1], "finger", result, step, ZERO)
    assert identify("drift", *bags) == 0
    path = tmp_path / "identified" / "cantilever.yaml"
    found = build(CantileverParameters, load(path, "cantilever"), str(path))
    assert found.creep.gain == pytest.approx(plant.creep.gain, rel=0.05)
    assert found.creep.gain_per_degc == pytest.approx(plant.creep.gain_per_degc, rel=0.05)


@pytest.mark.parametrize(
    ("model", "plays", "limit"), [("classical", 10, 0.90), ("modified", 20, 0.50)]
)
def test_measured_actuator_from_its_file(identify, tmp_path, model, plays, limit):
    assert identify("hysteresis", P885, *P885_COLUMNS, "--model", model, "--plays", plays) == 0
    fits = json.loads((tmp_path / "identified" / "hysteresis.json").read_text())
    assert fits["all 7627 samples, fitted"]["rms_percent"] <= limit
    assert fits["last 2288 samples, held back"]["rms_percent"] <= 0.95
    assert identify("check", P885, *P885_COLUMNS) == 0
    again = json.loads((tmp_path / "identified" / "check.json").read_text())
    assert again["rms_percent"] == pytest.approx(
        fits["all 7627 samples, fitted"]["rms_percent"], rel=1e-3
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hysteresis", P885), "Model_Vi_Do.dat: no column for 'voltage'; the file has 0, 1, 2"),
        (("hysteresis", P885, "--voltage", "9", "--deflection", "4"), "no column '9' for 'voltage'"),
        (("hysteresis", P885, *P885_COLUMNS, "--deflection", "1"), "column 'deflection' is 0 in all"),
        (("hysteresis", P885, *P885_COLUMNS, "--thresholds", "0,2"), "threshold 2 V never comes into"),
        (("stiffness", P885, *P885_COLUMNS[:-2]), "no column 'tip_force'"),
        (("check", P885, *P885_COLUMNS), "feedforward.yaml: cannot be read"),
        (("hysteresis", "none.csv"), "none.csv: cannot be read"),
        (("hysteresis", P885, *P885_COLUMNS, "--voltage", "4"), "column '4' cannot be both"),
        (("hysteresis", P885, *P885_COLUMNS, "--start", "50"), "0 samples, must be at least 50"),
        (("dynamics", P885, *P885_COLUMNS[:-2]), "no vibration is seen"),
    ],
)  # fmt: skip
def test_unusable_input_ends_with_code_2_and_says_why(identify, capsys, arguments, message):
    assert identify(*arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(("ends", "way"), [([150.0, 0.0], "falls"), ([75.0, -75.0, 0.0], "rises")])
def test_a_single_cycle_is_refused_for_what_it_lacks(identify, tmp_path, capsys, ends, way):
    """A triangle up and down from one end, or once around: one branch is left after both ends; two cycles do."""
    operator = HysteresisParameters((0.0, 5.0, 20.0, 45.0, 80.0), (6e-8, 1.2e-8, 1e-8, 8e-9, 5e-9))
    for cycles in (1, 2):
        turns = np.array([0.0, *(ends * cycles)])
        reached = np.append(0.0, np.cumsum(np.abs(np.diff(turns))))
        voltage = np.interp(np.arange(0.0, reached[-1], 0.15), reached, turns)
        noise = np.random.default_rng(3).normal(0.0, 5e-3, voltage.size)
        deflection = 1e6 * deflection_history(operator, voltage) + noise
        path = table(tmp_path / f"{cycles}.csv", voltage, deflection, rate=1000.0)
        assert identify("hysteresis", path) == (2 if cycles == 1 else 0)
        words = f"has been to both ends it only {way} in the rows"
        said = capsys.readouterr().err
        assert (words in said and "record two cycles or more" in said) == (cycles == 1)


LOOP = 30.0 * np.sin(2.0 * np.pi * np.arange(2000) / 200.0)  # V
PAPERS = 1e6 * deflection_history(HysteresisParameters(), LOOP)  # µm


def table(path, voltage, deflection, force=None, temperature=None, rate=200.0):
    """Write a recording as a table with deflections in µm, forces in mN; return its path."""
    columns = {
        "time": np.arange(len(voltage)) / rate,
        "voltage": voltage,
        "deflection_um": deflection,
    }
    columns |= {} if force is None else {"tip_force_mN": force}
    columns |= {} if temperature is None else {"temperature": temperature}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.mark.parametrize(
    ("command", "less", "columns"),
    [
        # A loop that one play in every second cycle does not follow: twice the stroke.
        ("hysteresis", "a straight line", (LOOP, 0.5 * LOOP * np.repeat([1.0, 0.85], 1000))),
        # A finger that answers at once, and its sensor's slow error: nothing vibrates.
        ("dynamics", "vibration", (LOOP, 0.5 * LOOP + 2.0 * np.sin(np.arange(2000) / 150.0))),
        # A force that does nothing, and a knock at the table.
        ("stiffness", "no force", (0.0 * LOOP, 5.0 * np.exp(-(((np.arange(2000) - 628) / 4.0) ** 2)), LOOP > 0.0)),
        # A deflection that neither creep nor heat explains.
        (
            "drift",
            "a finger without creep and heat",
            (LOOP, PAPERS + np.sin(np.arange(2000) / 50.0), None, 22.0 + 0.0 * LOOP),
        ),
    ],
    ids=["hysteresis", "dynamics", "stiffness", "drift"],
)  # fmt: skip
def test_a_fit_that_explains_no_more_than_less_of_a_model_is_not_written(
    identify, tmp_path, capsys, command, less, columns
):
    assert identify(command, table(tmp_path / "a.csv", *columns)) == 2
    assert less in capsys.readouterr().err
    assert not list((tmp_path / "identified").iterdir())


def test_a_butterfly_is_not_written(identify, tmp_path, capsys):
    """±1500 V at a ferroelectric: the deflection rises at both ends, as the public loop of 29.5 % rms."""
    voltage = 50.0 * LOOP
    turned = np.interp(
        voltage - 400.0 * np.sign(np.gradient(voltage)), [-2000, 0, 2000], [9.0, 0.0, 9.0]
    )
    assert identify("hysteresis", table(tmp_path / "a.csv", voltage, turned)) == 2
    assert "nothing written" in capsys.readouterr().err
    assert not list((tmp_path / "identified").iterdir())


def test_a_reversed_sensor_is_found_and_told_to_the_servo(identify, tmp_path, capsys):
    """What the servo makes of the raw readings is what was fitted."""
    raw = table(tmp_path / "raw.csv", LOOP, -0.5 * LOOP)
    assert identify("hysteresis", raw, "--plays", 4) == 2
    assert "the sign of the sensor is reversed; --reversed" in capsys.readouterr().err
    assert identify("hysteresis", raw, "--plays", 4, "--reversed") == 0
    out = tmp_path / "identified"
    feedforward = build(FeedforwardParameters, load(out / "feedforward.yaml", "feedforward"))
    servo = build(ServoNodeParameters, load(out / "servo.yaml", "servo"))
    assert feedforward.static_gain == pytest.approx(0.5e-6, rel=1e-6)
    assert servo.sensor_scale * -0.5e-6 * 30.0 == pytest.approx(feedforward.static_gain * 30.0)
    (out / "servo.yaml").write_text("/**/servo: {ros__parameters: {sensor_scale: -2e-5}}\n")
    assert identify("hysteresis", raw, "--plays", 4, "--reversed", "--overwrite") == 0
    assert "with sensor_scale -2e-05: it stays" in capsys.readouterr().out
    assert load(out / "servo.yaml", "servo") == {"sensor_scale": -2e-5}


def test_a_reversed_sensor_is_found_in_every_step(identify, tmp_path, capsys):
    time = np.arange(1000) * 2e-4
    step = np.where(time < 0.01, 0.0, 20.0)
    ringing = DynamicsModel(2.0 * np.pi * 300.0, 0.05, 0.5, 0.0, 0.0, 0).deflection(time, step)
    stepped = table(tmp_path / "step.csv", step, -ringing, rate=5e3)
    pushed = table(tmp_path / "push.csv", 0.0 * step, -ringing, 0.1 * step, rate=5e3)
    warm = table(tmp_path / "warm.csv", LOOP, -0.5 * LOOP, None, 22.0 + 0.0 * LOOP)
    for command, recording in (("dynamics", stepped), ("stiffness", pushed), ("drift", warm)):
        assert identify(command, recording) == 2
        assert "falls while" in capsys.readouterr().err
    assert identify("dynamics", stepped, "--reversed") == 0


@pytest.mark.parametrize("slip, code", [(0.0, 0), (1.0, 2)], ids=["noise", "a step"])
def test_a_voltage_may_move_as_far_as_it_does_not_move_the_finger(
    identify, tmp_path, capsys, slip, code
):
    """1 mV of a voltmeter's noise is 0.6 nm of 3 µm; 1 V with the force is 0.6 µm, a fifth, at the paper's 0.6 µm/V."""
    time = np.arange(2000) * 2e-4
    force = np.where(time < 0.02, 0.0, 1.0)  # mN
    ringing = DynamicsModel(2.0 * np.pi * 300.0, 0.05, 3.0, 0.0, 0.0, 0).deflection(time, force)
    voltage = slip * force + 1e-3 * np.random.default_rng(8).standard_normal(2000)
    pushed = table(tmp_path / "push.csv", voltage, ringing, force, rate=5e3)
    assert identify("stiffness", pushed) == code
    if code:
        assert "must be at most 1 %: hold the voltage" in capsys.readouterr().err
    else:
        found = load(tmp_path / "identified" / "cantilever.yaml", "cantilever")
        assert found["dynamics.elastic_constant"] == pytest.approx(3e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("sensor", "skip", "message"),
    [
        ("{lag: 0.0, offset: 0.0}", 99999, "a.csv: 0 samples, must be at least 50"),
        ("{lag: 0.0, offset: 0.0}", 1960, "a.csv: 40 samples, must be at least 50"),
        ("{offset: 0.0}", 0, "identification.yaml: no 'lag', which `identify hysteresis` writes"),
        ("{lag: late, offset: 0.0}", 0, "identification.yaml: 'lag' is 'late', must be of type float"),
        ("{lag: .inf, offset: 0.0}", 0, "identification.yaml: 'lag' is inf, must be in [-1000, 1000] s"),
    ],
)  # fmt: skip
def test_what_a_check_cannot_use_is_named(identify, tmp_path, capsys, sensor, skip, message):
    out = tmp_path / "identified"
    out.mkdir()
    (out / "feedforward.yaml").write_text(
        "/**/feedforward: {ros__parameters: {static_gain: 5e-7}}\n"
    )
    (out / "identification.yaml").write_text(f"/**/identification: {{ros__parameters: {sensor}}}\n")
    assert identify("check", table(tmp_path / "a.csv", LOOP, PAPERS), "--skip", skip) == 2
    assert message in capsys.readouterr().err


def test_what_drift_is_not_told_is_said_and_not_written(identify, tmp_path, capsys):
    """A laboratory at 25 °C, and a warm-up at 0 V: the slope of the creep is assumed, then kept when it is known."""
    creep = CreepParameters(gain=5e-9, gain_per_degc=2e-10)
    plant = CantileverParameters(sample_time=2e-2, creep=creep)
    warming = TemperatureParameters(profile="step", base_degc=25.0, amplitude_degc=6.0, start=2.0)
    at_25 = TemperatureParameters(profile="constant", base_degc=25.0)
    bags = []
    for temperatures, voltage, samples in (
        (at_25, Profile([0.0, 1.0], [0.0, 40.0]), 15_000),
        (warming, ZERO, 1000),
    ):
        bags.append(tmp_path / f"bag_{samples}")
        result = drive(plant, temperatures, voltage, samples)
        write_recording(bags[-1], "finger", result, voltage, ZERO)
    path = tmp_path / "identified" / "cantilever.yaml"
    assert identify("drift", *bags) == 0
    said = capsys.readouterr().out
    assert "at 25 °C; how it depends on the temperature these recordings do not tell" in said
    assert "gain_per_degc and lag_per_degc are not told from 0: not written" in said
    found = load(path, "cantilever")
    assert found["thermal.sensitivity"] == pytest.approx(plant.thermal.sensitivity, rel=0.01)
    assert "thermal.gain_per_degc" not in found and "thermal.lag_per_degc" not in found
    assert found["creep.gain"] == pytest.approx(5.6e-9, rel=0.05)  # 5e-9 + 3 °C 2e-10
    assert found["creep.gain_per_degc"] == 0.0
    assert "at 25 °C; how it depends" in path.read_text()
    path.write_text("/**/cantilever: {ros__parameters: {creep: {gain_per_degc: 2e-10}}}\n")
    assert identify("drift", *bags) == 0
    known = load(path, "cantilever")
    assert known["creep.gain_per_degc"] == 2e-10
    assert known["creep.gain"] == pytest.approx(found["creep.gain"] - 6e-10, rel=1e-9)


def test_only_the_asked_part_of_a_recording_is_used(identify, tmp_path):
    """From 5 to 25 s of the p885 recording: 4000 rows."""
    assert identify("hysteresis", P885, *P885_COLUMNS, "--start", 5, "--end", 25) == 0
    fits = json.loads((tmp_path / "identified" / "hysteresis.json").read_text())
    assert "all 3600 samples, fitted" in fits  # without the 400 to skip


@pytest.mark.parametrize(
    "option",
    ["--skip=-5", "--plays=0", "--dead-zones=-1", "--sample-rate=0", "--sample-rate=nan", "--start=nan",
     "--end=-1", "--lag=inf", "--hold-back=1", "--sensor-delay=-1"],
)  # fmt: skip
def test_an_option_out_of_its_range_is_refused(identify, capsys, option):
    with pytest.raises(SystemExit):
        identify("hysteresis", P885, option)
    assert "is not within [" in capsys.readouterr().err


def test_nothing_is_replaced_unasked_and_no_bad_fit_is_written(identify, tmp_path, capsys):
    time = 0.005 * np.arange(400)
    voltage = 30.0 * np.sin(2.0 * np.pi * time)
    rows = np.column_stack((time, voltage, 0.5 * voltage))
    good, outlier = tmp_path / "good.csv", tmp_path / "outlier.csv"
    np.savetxt(good, rows, delimiter=",", header="time,voltage,deflection_um", comments="")
    rows[200, 1] = 400.0  # one reading of the voltmeter
    rows[:, 2] += np.random.default_rng(1).normal(0.0, 8.0, 400)
    np.savetxt(outlier, rows, delimiter=",", header="time,voltage,deflection_um", comments="")
    words = ("--plays", "4", "--skip", "0", "--lag", "0")
    assert identify("hysteresis", outlier, *words) == 2
    assert "too small an excursion" in capsys.readouterr().err
    path = tmp_path / "identified" / "feedforward.yaml"
    assert not path.exists()
    assert identify("hysteresis", good, *words) == 0
    before = path.read_text()
    assert build(FeedforwardParameters, load(path, "feedforward")).voltage_high == 40.0
    assert identify("hysteresis", good, *words) == 2
    assert "--overwrite" in capsys.readouterr().err and path.read_text() == before
    assert identify("hysteresis", good, *words, "--overwrite") == 0


def test_what_others_wrote_into_a_file_stays_and_what_is_not_found_again_goes(identify, tmp_path):
    """Limits of an actuator of one polarity, the dynamics; a lag that a second recording does not show."""
    slow = CantileverParameters(amplifier=AmplifierParameters(bandwidth_hz=1000.0))
    bag = recorded(
        tmp_path / "excite",
        CantileverParameters(sample_time=1e-3),
        decaying_sine(40.0, cycles=6),
        6.0,
    )
    step = Profile([0.0, 0.01], [0.0, 30.0])
    lagging = recorded(tmp_path / "lagging", slow, step, 0.08)
    quick = recorded(tmp_path / "quick", CantileverParameters(), step, 0.08)
    out = tmp_path / "identified"
    assert identify("hysteresis", bag) == 0
    assert identify("dynamics", lagging) == 0
    found = load(out / "cantilever.yaml", "cantilever")
    assert found["amplifier.bandwidth_hz"] == pytest.approx(1000.0, rel=0.02)
    stands = load(out / "feedforward.yaml", "feedforward") | {
        "voltage_low": -30.0,
        "voltage_high": 120.0,
    }
    dump(out / "feedforward.yaml", "feedforward", stands, "mine")
    assert identify("dynamics", quick) == 0
    assert load(out / "cantilever.yaml", "cantilever")["amplifier.bandwidth_hz"] == 0.0
    assert identify("hysteresis", bag, "--overwrite") == 0
    after = load(out / "feedforward.yaml", "feedforward")
    assert (after["voltage_low"], after["voltage_high"]) == (-30.0, 120.0)
    assert "dynamics.denominator" in after
    assert "# mine" in (out / "feedforward.yaml").read_text()


def test_a_delay_is_written_in_samples_of_the_loop(identify, tmp_path, capsys):
    """100 µs, of which a recording at 50 kHz has five rows: one sample of the loop at 10 kHz, five of one at 50."""
    time = np.arange(2500) * 2e-5
    voltage = np.where(time < 2e-3, 0.0, 20.0)
    model = DynamicsModel(2.0 * np.pi * 700.0, 0.02, 0.5, 0.0, 0.0, 1e-4)  # µm per V
    table = np.column_stack((time, voltage, model.deflection(time, voltage)))
    path = tmp_path / "fast.csv"
    np.savetxt(
        path, table, delimiter=",", header="time (s),voltage (V),deflection (um)", comments=""
    )
    assert identify("dynamics", path) == 0
    out = tmp_path / "identified" / "cantilever.yaml"
    assert load(out, "cantilever")["sensor.delay_samples"] == 1
    assert "found are 100 µs, 5 rows of 20 µs" in capsys.readouterr().out.replace("\n", " ")
    dump(out, "cantilever", {"sample_time": 2e-5}, "a faster loop")
    assert identify("dynamics", path) == 0
    assert load(out, "cantilever")["sensor.delay_samples"] == 5
