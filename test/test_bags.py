# SPDX-License-Identifier: Apache-2.0
"""Bags as users make them: several references in one, lost samples, late joiners, clocks on the wall."""

import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Temperature
from test_table import COLUMNS, FORMATS

from piezo_control.profile import Profile
from piezo_control.recording.recording import (
    PROFILE_TYPE,
    SAMPLE_TYPE,
    TEMPERATURE_TYPE,
    BagError,
    Recording,
    read,
)
from piezo_control.recording.writer import BagWriter
from piezo_gripper_msgs.msg import Profile as ProfileMessage
from piezo_gripper_msgs.msg import Sample
from piezo_sim.experiment.analysis import classify, steps
from piezo_sim.experiment.bags import analyse_bags, analysed, compare_bags
from piezo_sim.experiment.cli import main

H = 1e-3  # s
LAG = 0.02  # s, of a finger that follows with a first-order lag: settles to 5 % in 3.0 and to 2 % in 3.9 lags
WALL = 1_764_000_000 * 10**9  # ns


def follow(reference, sample_time=H, lag=LAG):
    """Return the exact response of a first-order lag to a reference that is held from sample to sample."""
    kept, value, response = np.exp(-sample_time / lag), 0.0, []
    for wanted in reference:
        response.append(value)
        value = wanted + kept * (value - wanted)
    return np.array(response)


def recording(**signals):
    """Return a recording with these signals; the others were not recorded."""
    count = len(next(iter(signals.values())))
    nothing = dict.fromkeys(
        (f.name for f in fields(Recording) if f.name not in ("number", "time")),
        np.full(count, np.nan),
    )
    return Recording(number=np.arange(count), time=H * np.arange(count), **{**nothing, **signals})


class Session:
    """A finger in a bag as `ros2 bag record` makes it: stamps of the wall, its own time of receipt."""

    def __init__(self, path):
        self.bag = BagWriter(path)
        self.topics = {}

    def put(self, name, kind, message, stamp, received):
        if name not in self.topics:
            self.topics[name] = self.bag.add(f"/f/{name}", kind)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
        self.bag.write(self.topics[name], received, serialize_message(message))

    def sample(self, name, number, value, stamp, delay=30_000):
        message = Sample(number=number, value=float(value), period=H)
        self.put(name, SAMPLE_TYPE, message, stamp, stamp + delay)


REFERENCE = np.repeat([5e-6, 10e-6, -5e-6], 300)


def session(path, first=0, lost=(), voltage_from=0, said=True):
    """Write profile 5 µm, set-point 10 µm, profile -5 µm; each arrives at the recorder before it is followed."""
    bag = Session(path)
    deflection = follow(REFERENCE)
    for number in range(first, REFERENCE.size):
        stamp = WALL + number * 1_000_000
        if number % 300 == 0 or number == first:
            asked = ProfileMessage(time=[0.0], value=[REFERENCE[number]])
            before = stamp - 12_000_000  # twelve samples earlier
            if number == 300:
                bag.put("reference", SAMPLE_TYPE, Sample(value=10e-6), 0, before)
            else:
                bag.put("reference_profile", PROFILE_TYPE, asked, 0, before)
            if said:
                bag.put("reference_followed_profile", PROFILE_TYPE, asked, stamp, stamp + 900_000)
        if number not in lost:
            bag.sample("deflection", number, deflection[number], stamp)
        if number >= voltage_from and number + 1 not in lost:
            bag.sample("command", number, REFERENCE[number], stamp, 200_000)
            bag.sample("voltage", number, 2e6 * REFERENCE[number] + number % 2, stamp, 400_000)
        if number % 100 == 50:
            warm = Temperature(temperature=22.0 + 0.01 * (number % 3))
            bag.put("temperature", TEMPERATURE_TYPE, warm, stamp, stamp)
    bag.bag.close()
    return path


def test_the_reference_is_the_one_that_was_followed(tmp_path):
    np.testing.assert_array_equal(read(session(tmp_path / "said")).reference, REFERENCE)
    arrived = read(session(tmp_path / "silent", said=False)).reference
    np.testing.assert_array_equal(arrived[:288], REFERENCE[:288])
    assert arrived[289] == 10e-6  # the best that can be known: when it came


def test_every_step_has_its_figures(tmp_path):
    (one,) = analysed([session(tmp_path / "bag")]).values()
    assert one.kind == "step" and one.left_out == ""
    assert list(one.figures) == ["0 s: 0 → 5 µm", "0.3 s: 5 → 10 µm", "0.6 s: 10 → -5 µm"]
    for figures, reference in zip(one.figures.values(), (5.0, 10.0, -5.0)):
        assert figures["reference_um"] == pytest.approx(reference)
        assert figures["settling_time_5pct_ms"] == pytest.approx(np.log(20) * LAG * 1e3, abs=1.01)
        assert figures["settling_time_2pct_ms"] == pytest.approx(np.log(50) * LAG * 1e3, abs=1.01)
        assert figures["rise_time_ms"] == pytest.approx(np.log(9) * LAG * 1e3, abs=0.05)
        assert figures["overshoot_percent"] == 0.0 and figures["static_error_percent"] < 0.01


def test_a_ramp_from_value_to_value_is_one_step():
    time = H * np.arange(2000)
    reference = Profile([0.5, 0.7, 1.5, 1.6], [0.0, 2e-5, 2e-5, -1e-5], linear=True).at(time)
    found = steps(recording(reference=reference, deflection=follow(reference)))
    assert [(p.reference[0], p.reference[-1]) for p in found] == [(0.0, 2e-5), (2e-5, -1e-5)]
    assert [p.time[0] for p in found] == pytest.approx([0.5, 1.5], abs=1.5 * H)
    assert found[0].time[-1] == pytest.approx(1.5, abs=1.5 * H)


def test_what_is_missing_is_left_out_and_said(tmp_path):
    lost = {400, 401, 700}
    path = session(tmp_path / "bag", first=100, lost=lost, voltage_from=140)
    (one,) = analysed([path]).values()
    assert one.left_out == (
        "left out: 40 at the beginning, without command or voltage; 2 in between, without command or voltage; "
        "the bag begins at sample 100; 3 of 800 samples were not recorded, the first is 400"
    )
    kept = [n for n in range(140, 900) if n not in lost | {n - 1 for n in lost}]
    assert one.recording.number.tolist() == kept
    np.testing.assert_array_equal(one.recording.reference, REFERENCE[kept])
    assert np.isfinite(one.recording.temperature).all()
    # It was there at the beginning, so no step is seen of it.
    assert list(one.figures) == ["0.2 s: 5 → 10 µm", "0.5 s: 10 → -5 µm"]
    # 3 of 40 ms are between lost samples: the figures stay those of the lag.
    assert one.figures["0.5 s: 10 → -5 µm"]["settling_time_5pct_ms"] == pytest.approx(60, abs=1.5)


def test_bags_with_as_many_steps_are_compared_step_by_step(tmp_path):
    found = analysed([session(tmp_path / "a"), session(tmp_path / "b", lost={450})])
    section, _ = compare_bags(found, tmp_path)
    assert [row[0] for row in section.rows][:4] == [
        "a 0 s: 0 → 5 µm", "a 0.3 s: 5 → 10 µm", "a 0.6 s: 10 → -5 µm", "b 0 s: 0 → 5 µm",
    ]  # fmt: skip
    assert section.rows[6][0] == "  b − a 0 s: 0 → 5 µm" and float(section.rows[6][2]) == 0.0
    assert "b: 898 samples" in section.text and "1 of 900 samples were not recorded" in section.text


def test_a_bag_without_one_whole_sample_is_refused():
    nan = np.full(50, np.nan)
    halves = [np.concatenate(h) for h in ((np.ones(50), nan), (nan, np.ones(50)))]
    with pytest.raises(BagError, match="no sample has all of deflection, voltage"):
        recording(deflection=halves[0], voltage=halves[1]).complete()


def test_an_excitation_is_no_frequency_response():
    """A decaying sine of the voltage, of which the reference is a multiple; a multisine; noise on a sine."""
    time = H * np.arange(20_000)
    sine = np.sin(2 * np.pi * time)
    decaying = 40.0 * np.minimum(1.0, (20 - time) / 19) * sine
    noise = np.random.default_rng(1).normal(0.0, 0.1, time.size)
    many = sum(np.sin(2 * np.pi * f * time + f**2) for f in (0.5, 1.1, 2.3, 5.3))
    base = {"temperature": np.full(time.size, 22.0), "tip_force": np.zeros(time.size)}

    def kind(reference, voltage):
        return classify(recording(reference=reference, voltage=voltage, deflection=voltage, **base))

    assert kind(decaying * 1e-6, decaying) == "excite"
    assert kind(np.full(time.size, np.nan), decaying + noise) == "excite"
    assert kind(sine * 1e-6, 40 * sine) == "hysteresis"
    assert kind(sine * 1e-6, 40 * sine + 5 * sine**3) == "feedforward"
    assert kind(many * 1e-6, 40 * many + 5 * many**3) == "frequency"


def test_tables_are_analysed_as_bags_are(tmp_path):
    """The same session as a spreadsheet would have it: figures as from the bag, a lost row counted."""
    deflection, rows = follow(REFERENCE), np.delete(np.arange(REFERENCE.size), 450)
    lines = ["Zeit (ms);Soll [µm];Ist [µm];U [V]"]
    for k in rows:
        values = (1e3 * H * k, 1e6 * REFERENCE[k], 1e6 * deflection[k], 2e6 * REFERENCE[k] + k % 2)
        lines.append(";".join(f"{value:.6f}".replace(".", ",") for value in values))
    table = tmp_path / "session.csv"
    table.write_text("\n".join(lines), encoding="cp1252")
    columns = {"time": "Zeit", "reference": "Soll", "deflection": "Ist", "voltage": "U"}
    found = analysed([table, session(tmp_path / "bag")], columns=columns)
    one, other = found["session.csv"], found["bag"]
    assert "deflection = column 'Ist [µm]' [um]" in one.left_out
    assert "1 of 900 samples were not recorded, the first is 450" in one.left_out
    assert list(one.figures) == list(other.figures)
    for figures, others in zip(one.figures.values(), other.figures.values()):
        assert figures["settling_time_2pct_ms"] == pytest.approx(others["settling_time_2pct_ms"])
        assert figures["rise_time_ms"] == pytest.approx(others["rise_time_ms"], abs=0.01)
    with pytest.raises(
        BagError, match="session.csv: no column for 'deflection'; the file has Zeit"
    ):
        analysed([table])


@pytest.mark.parametrize("path", sorted(FORMATS.iterdir()), ids=lambda path: path.name)
def test_every_table_that_identify_reads_is_analysed(path):
    """A finger of 0.5 µm/V between -20 and 20 V, in the shapes of test/data/formats."""
    (one,) = analysed([path], "hysteresis", columns=COLUMNS.get(path.name)).values()
    assert one.figures[""]["peak_to_peak_um"] == pytest.approx(20.0, rel=1e-3)
    assert one.figures[""]["slope_um_per_v"] == pytest.approx(0.5, rel=1e-3)


def test_tables_are_analysed_and_compared_on_the_command_line(monkeypatch, tmp_path, capsys):
    table, other = FORMATS / "savetxt.dat", FORMATS / "bars.txt"
    for number, words in enumerate(
        (["analyse", table, "--voltage", "voltage"], ["compare", table, other])
    ):
        out = tmp_path / str(number)
        monkeypatch.setattr(sys, "argv", ["experiment", *map(str, words), "--out", str(out)])
        assert main() == 0, capsys.readouterr().err
        assert (out / "report.html").exists()


def command(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["experiment", *map(str, words)])
    return main()


def test_a_figure_that_one_recording_lacks_has_no_difference(tmp_path):
    """Tables do not say whether a limit acted; bags do."""
    figures = analysed([session(tmp_path / "bag")])["bag"]
    of_table = {
        name: {q: value for q, value in one.items() if q != "limited_percent"}
        for name, one in figures.figures.items()
    }
    found = {"table": replace(figures, figures=of_table), "bag": figures}
    section, _ = compare_bags(found, tmp_path)
    column = section.columns.index("at a limit [% of samples]")
    (row, *_) = (row for row in section.rows if row[0].startswith("  bag − table"))
    assert row[column] == "–" and row[column - 1] != "–"


def test_why_recordings_of_other_steps_are_not_subtracted_is_said(tmp_path):
    found = analysed([session(tmp_path / "a"), session(tmp_path / "b", first=100)])
    section, _ = compare_bags(found, tmp_path)
    assert section.rows[-1][0] == "  b − a: none, steps: 2 and 3"
    assert set(section.rows[-1][1:]) == {"–"}


def test_a_recording_that_cannot_be_analysed_stops_no_other(monkeypatch, tmp_path, capsys):
    good = [session(tmp_path / name) for name in "ab"]
    for number, words in enumerate((["analyse", *good], ["compare", *good])):
        out = tmp_path / f"out{number}"
        assert command(monkeypatch, *words, tmp_path / "none", "--out", out) == 1
        said = capsys.readouterr()
        assert f"left out: {tmp_path}/none: " in said.err
        assert "0.6 s: 10 → -5 µm" in " ".join(said.out.split()) and (out / "report.html").exists()
    assert (
        command(monkeypatch, "compare", good[0], tmp_path / "b/../a", "--out", tmp_path / "c") == 2
    )
    assert "compare needs two bags or more, not 1" in capsys.readouterr().err
    assert command(monkeypatch, "compare", good[0], tmp_path / "none", "--out", tmp_path / "c") == 1
    assert "1 of 2 recordings can be analysed" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_recovered_bags_are_told_apart_and_named_where_they_are(monkeypatch, tmp_path, capsys):
    bags = [session(tmp_path / side / "bag") for side in ("left", "right")]
    out = tmp_path / "out"
    assert command(monkeypatch, "recover", *bags, "--out", out) == 0
    assert f"written to {out}/left/bag" in capsys.readouterr().out
    for side, bag in zip(("left", "right"), bags):
        np.testing.assert_array_equal(read(out / side / "bag").deflection, read(bag).deflection)
    monkeypatch.chdir(bags[0])
    assert command(monkeypatch, "recover", ".", "bag.mcap", "--out", tmp_path / "here") == 1
    assert "which exists" in capsys.readouterr().err  # the file is the folder's own
    assert [p.name for p in (tmp_path / "here").iterdir()] == ["bag"]
    assert command(monkeypatch, "recover", "bag.mcap", "--out", tmp_path / "file") == 0
    assert (tmp_path / "file" / "bag" / "bag.mcap").exists()


def test_a_bag_of_which_nothing_can_be_read_is_not_recovered(monkeypatch, tmp_path, capsys):
    BagWriter(tmp_path / "empty").close()
    out = tmp_path / "out"
    assert command(monkeypatch, "recover", tmp_path / "empty", "--out", out) == 1
    assert f"{tmp_path}/empty: no message can be read of it" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty"]


def part_of(path, reference, voltage, deflection, first):
    """Write the samples of a loop that was recorded from sample `first` on."""
    bag = Session(path)
    for number, values in enumerate(zip(reference, deflection, voltage)):
        stamp = WALL + number * 1_000_000
        for name, value in zip(("reference", "deflection", "voltage"), values):
            bag.sample(name, first + number, value, stamp, 0 if name == "reference" else 30_000)
        bag.sample("command", first + number, values[0], stamp)
    bag.bag.close()
    return path


def test_what_a_recording_looks_like_is_what_it_can_be_analysed_as(tmp_path):
    """A decaying sine that is followed has no cycle from maximum to maximum, a finger that holds no step."""
    time = H * np.arange(1000)
    decaying = 1e-5 * np.exp(-3 * time) * np.sin(2 * np.pi * 5 * time)
    home = part_of(tmp_path / "home", decaying, 2e6 * decaying + time, decaying, 500)
    held = np.full(1000, 5e-6)
    swing = 1e-8 * np.sin(2 * np.pi * 50 * time)
    rest = part_of(tmp_path / "rest", held, 10.0 + time, held + 1e-7 + swing, 500)
    found = analysed([home, rest])
    assert {name: one.kind for name, one in found.items()} == {"home": "excite", "rest": "hold"}
    figures = found["rest"].figures[""]
    assert figures["reference_um"] == pytest.approx(5.0)
    assert figures["mean_error_um"] == pytest.approx(0.1)
    assert figures["peak_to_peak_um"] == pytest.approx(0.02)
    assert len(analyse_bags(found, tmp_path)) == 3


def test_a_recording_that_fits_no_kind_is_refused_by_what_it_looks_like():
    ramp = np.linspace(0.0, 1e-5, 1000)
    signals = {"temperature": np.full(1000, 22.0), "tip_force": np.zeros(1000)}
    with pytest.raises(BagError, match="analysed as 'step': the reference goes from no value"):
        classify(recording(reference=ramp, deflection=ramp, voltage=ramp**2, **signals))
