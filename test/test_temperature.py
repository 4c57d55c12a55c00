# SPDX-License-Identifier: Apache-2.0
"""Temperature profiles against their definitions; replay refuses unusable files by name."""

import math
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.integrate import solve_ivp

from piezo_control.parameters import ParameterError
from piezo_control.sequence import grid_index
from piezo_sim.temperature import PROFILES, TemperatureParameters, temperature


def values(count=20000, first=0, **changes):
    return temperature(TemperatureParameters(**changes), first, count)


@given(
    st.sampled_from(PROFILES[:-1]), st.integers(0, 30000), st.integers(0, 5000), st.floats(0.0, 5.0)
)
@settings(max_examples=50)
def test_a_value_does_not_depend_on_what_else_is_asked_for(profile, first, count, start):
    changes = {"profile": profile, "start": start}
    whole = values(first + count, **changes)
    assert np.array_equal(values(count, first, **changes), whole[first:])


def test_constant_step_ramp_and_sine():
    assert np.all(values(profile="constant", base_degc=25.0) == 25.0)
    step = values(profile="step", start=1.0)
    assert step[999] == 22.0 and step[1000] == 32.0 and step[-1] == 32.0
    ramp = values(profile="ramp", start=1.0, duration=4.0)
    assert ramp[[0, 1000, 2000, 5000, 19999]] == pytest.approx([22.0, 22.0, 24.5, 32.0, 32.0])
    sine = values(profile="sine", start=1.0, frequency_hz=0.5)
    assert sine[[500, 1000, 1500, 2500]] == pytest.approx([22.0, 22.0, 32.0, 12.0])


@pytest.mark.parametrize("on_time, repeat_time, time_constant", [(2.0, 5.0, 1.5), (3.0, 3.0, 0.4)])
def test_spotlight_solves_the_first_order_law(on_time, repeat_time, time_constant):
    got = values(
        profile="spotlight", start=1.0, on_time=on_time, repeat_time=repeat_time,
        time_constant=time_constant,
    )  # fmt: skip

    def law(time, degc):
        lit = time >= 1.0 and (time - 1.0) % repeat_time < on_time
        return (22.0 + 10.0 * lit - degc) / time_constant

    time = np.arange(20000) * 1e-3
    exact = solve_ivp(law, (0, time[-1]), [22.0], t_eval=time, max_step=1e-3).y[0]
    np.testing.assert_allclose(got, exact, atol=10.0 * 1e-3 / time_constant)  # switching in a step


def test_random_walk_has_the_deviation_and_the_memory_asked_for():
    walk = values(400000, profile="random_walk", amplitude_degc=2.0, time_constant=0.05) - 22.0
    # 4000 independent values: standard deviation and mean are known to 1.1 % and 1.6 %, times 4.
    assert np.std(walk) == pytest.approx(2.0, rel=0.05)
    assert np.mean(walk) == pytest.approx(0.0, abs=0.15)
    memory = np.mean(walk[:-50] * walk[50:]) / np.var(walk)
    assert memory == pytest.approx(math.exp(-1.0), abs=0.05)
    other = values(100, profile="random_walk", seed=2)
    assert not np.array_equal(other, values(100, profile="random_walk"))


def test_grid_index_is_exact_where_floats_are_not():
    samples = np.arange(100_000)
    assert np.array_equal(grid_index(samples, 1e-4, 1e-3), samples // 10)
    assert grid_index(3, 1e-3, 3e-3) == 1
    assert grid_index(10**12, 1e-4, 1e-3) == 10**11


def test_replay_of_a_csv_joins_its_points(tmp_path):
    file = tmp_path / "t.csv"
    file.write_text("temperature, time, remark\n22.0,0.0,a\n32.0,2.0,b\n30.0,3.0,c\n")
    got = values(4000, profile="replay", file=str(file))
    assert got[[0, 1000, 2000, 2500, 3999]] == pytest.approx([22.0, 27.0, 32.0, 31.0, 30.0])


def test_replay_reads_kelvin_where_the_heading_says_so(tmp_path):
    file = tmp_path / "t.csv"
    file.write_text("time,temperature [K]\n0.0,295.15\n1.0,305.15\n")
    assert values(2, profile="replay", file=str(file))[0] == pytest.approx(22.0)
    file.write_text("time,temperature\n0.0,295.15\n1.0,305.15\n")
    with pytest.raises(ParameterError, match=r"may be kelvin: .*'temperature \[K\]'"):
        values(2, profile="replay", file=str(file))


def test_a_csv_that_changed_is_read_again(tmp_path):
    file = tmp_path / "t.csv"
    for number, degc in enumerate((22.0, 23.0)):
        file.write_text(f"time,temperature\n0.0,{degc}\n")
        os.utime(file, (number, number))
        assert values(1, profile="replay", file=str(file)) == [degc]


@pytest.mark.parametrize(
    "text, message",
    [
        ("time,deg\n0,22\n", "no column for 'temperature'; the file has time, deg"),
        ("", "no rows"),
        ("time,temperature\n", "has no rows"),
        (
            "time,temperature\n0,22\n1,nan\n",
            "column 'temperature', row 3 is 'nan', must be a finite number",
        ),
        (
            "time,temperature\n0,22\n1,1e300\n",
            "column 'temperature', row 3 is 1e\\+300, must be within",
        ),
        ("time,temperature\n0,22\nx,22\n", "column 'time', row 3 is 'x', must be a finite number"),
        ("time,temperature\n0,22\n1,22\n1,23\n", "column 'time', row 4: 1.0 s comes after 1.0 s"),
    ],
)
def test_an_unusable_csv_is_refused_by_column_and_row(tmp_path, text, message):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(ParameterError, match=f"bad.csv: {message}"):
        values(1, profile="replay", file=str(file))


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ParameterError, match="none.csv: cannot be read"):
        values(1, profile="replay", file=str(tmp_path / "none.csv"))


def write_bag(path, degrees, message_type="sensor_msgs/msg/Temperature"):
    store = get_typestore(Stores.ROS2_JAZZY)
    header = store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/finger/temperature", message_type, typestore=store)
        for n, value in enumerate(degrees):
            fields = (header(stamp(100 + n, 0), ""), value)
            if message_type.endswith("Temperature"):
                fields += (0.0,)
            else:
                fields = (value,)
            raw = store.serialize_cdr(store.types[message_type](*fields), message_type)
            writer.write(connection, n, raw)


def test_replay_of_a_bag_counts_from_its_first_stamp(tmp_path):
    write_bag(tmp_path / "bag", [22.0, 32.0, 30.0])
    changes = {"profile": "replay", "file": str(tmp_path / "bag"), "topic": "/finger/temperature"}
    got = values(3000, **changes)
    assert got[[0, 500, 1000, 1500, 2999]] == pytest.approx([22.0, 27.0, 32.0, 31.0, 30.0])
    with pytest.raises(ParameterError, match="topic '/t' is missing; .*/finger/temperature"):
        values(1, **(changes | {"topic": "/t"}))


@pytest.mark.parametrize(
    "degrees, message_type, message",
    [
        ([22.0, math.nan], "sensor_msgs/msg/Temperature", "message 1 is nan degC"),
        ([], "sensor_msgs/msg/Temperature", "has no messages"),
        ([22.0], "std_msgs/msg/Float64", "is of type std_msgs/msg/Float64, must be"),
    ],
)
def test_an_unusable_bag_is_refused(tmp_path, degrees, message_type, message):
    write_bag(tmp_path / "bag", degrees, message_type)
    with pytest.raises(ParameterError, match=f"bag: topic '/finger/temperature'.* {message}"):
        values(1, profile="replay", file=str(tmp_path / "bag"), topic="/finger/temperature")


def test_a_folder_that_is_no_bag_is_refused(tmp_path):
    with pytest.raises(ParameterError, match="cannot be read as a bag"):
        values(1, profile="replay", file=str(tmp_path))


def test_parameters_that_do_not_fit_are_refused():
    with pytest.raises(ParameterError, match="'on_time' is 11.0 s, must be at most 'repeat_time'"):
        TemperatureParameters(profile="spotlight", on_time=11.0)
    with pytest.raises(ParameterError, match="'file' is empty"):
        TemperatureParameters(profile="replay")
