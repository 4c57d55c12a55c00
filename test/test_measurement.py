# SPDX-License-Identifier: Apache-2.0
"""Reading recordings: what is paired with what, and what is refused, by file, column and row."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from piezo_control.identification.measurement import Measurement, MeasurementError, read_measurement

SAMPLE = "piezo_gripper_msgs/msg/Sample"
TEMPERATURE = "sensor_msgs/msg/Temperature"
MSG = Path(__file__).parents[1] / "msg_defs" / "msg" / "Sample.msg"


def write_csv(path, rows=80, header="time,voltage,deflection_um,temperature", replace=None):
    """Write a finger's recording; `replace` maps a line number to another text."""
    lines = [header] if header else []
    for k in range(rows):
        lines.append(f"{0.01 * k:.2f},{0.5 * k},{0.25 * k},{22 + 0.1 * k:.1f}")
    for number, text in (replace or {}).items():
        lines[number - 1] = text
    path.write_text("\n".join(lines) + "\n")
    return path


def write_bag(path, voltage, deflection, temperature=None, sample_time=1e-3, prefix=""):
    """Write what the recorder writes of a lock-step run."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(MSG.read_text(), SAMPLE))
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        def put(topic, kind, fields):
            connection = writer.add_connection(f"{prefix}/{topic}", kind, typestore=store)
            for number, value in fields:
                nanoseconds = round(number * sample_time * 1e9)
                at = header(stamp(*divmod(nanoseconds, 10**9)), "")
                message = (
                    store.types[kind](at, number, value, sample_time, False, False, False)
                    if kind == SAMPLE
                    else store.types[kind](at, value, 0.0)
                )
                writer.write(connection, nanoseconds, store.serialize_cdr(message, kind))

        put("deflection", SAMPLE, enumerate(deflection))
        put("voltage", SAMPLE, enumerate(voltage))
        if temperature is not None:
            put("temperature", TEMPERATURE, enumerate(temperature))
    return path


def test_micrometres_taken_for_metres_are_refused(tmp_path):
    with pytest.raises(
        MeasurementError, match="spans 19.75 m, must be at most .*--deflection COLUMN:um"
    ):
        read_measurement(
            write_csv(tmp_path / "a.csv", header="time,voltage,deflection,temperature")
        )


def test_text_with_names_and_units(tmp_path):
    measurement = read_measurement(write_csv(tmp_path / "a.csv"))
    np.testing.assert_allclose(measurement.deflection[:3], [0.0, 0.25e-6, 0.5e-6])
    np.testing.assert_allclose(measurement.temperature[:2], [22.0, 22.1])
    assert measurement.tip_force is None
    assert measurement.sample_time == pytest.approx(0.01)


def test_text_without_names_but_numbers_and_sample_time(tmp_path):
    path = tmp_path / "a.dat"
    np.savetxt(path, np.column_stack((np.zeros(60), np.arange(60.0), np.arange(60.0) ** 2)))
    columns = {"voltage": "1:mV", "deflection": "2:nm"}
    measurement = read_measurement(path, columns, sample_time=0.005)
    np.testing.assert_allclose(measurement.voltage[:3], [0.0, 1e-3, 2e-3])
    np.testing.assert_allclose(measurement.deflection[:3], [0.0, 1e-9, 4e-9])
    np.testing.assert_allclose(measurement.time[:3], [0.0, 0.005, 0.01])


@pytest.mark.parametrize(
    ("replace", "message"),
    [
        ({30: "0.28,nan,1.0,22"}, "column 'voltage', row 30 is 'nan', must be a finite number"),
        ({30: "0.28,1.0,inf,22"}, "column 'deflection', row 30 is inf"),
        (
            {30: "0.28,1.0,much,22"},
            "column 'deflection_um', row 30 is 'much', must be a finite number",
        ),
        (
            {n: "0.28,1.0" for n in (30, 31)},
            "2 of 80 rows have an empty cell .*, the first is row 30",
        ),
        ({30: "0.20,1.0,1.0,22"}, "column 'time', row 30 is 0.2: not after 0.27"),
        ({1: "t,voltage,deflection_um,temperature"}, "no column for 'time' and no sample time"),
        ({1: "time,u,deflection_um,temperature"}, "no column for 'voltage'; the file has time, u,"),
    ],
)
def test_unusable_text_is_refused_by_file_column_and_row(tmp_path, replace, message):
    path = write_csv(tmp_path / "bad.csv", replace=replace)
    with pytest.raises(MeasurementError, match=f"{path}: .*{message}"):
        read_measurement(path)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"deflection": "x:um"}, "no column 'x' for 'deflection'; the file has time, voltage"),
        ({"deflection": "deflection_um:inch"}, "unit 'inch' must be one of m, mm, um, nm"),
    ],
)
def test_wrong_columns_are_refused(tmp_path, columns, message):
    with pytest.raises(MeasurementError, match=message):
        read_measurement(write_csv(tmp_path / "a.csv"), columns)


def test_too_short_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(MeasurementError, match="short.csv: 20 samples, must be at least 50"):
        read_measurement(write_csv(tmp_path / "short.csv", rows=20))
    with pytest.raises(MeasurementError, match="none.csv: cannot be read"):
        read_measurement(tmp_path / "none.csv")
    (tmp_path / "empty.csv").write_text("# nothing\n")
    with pytest.raises(MeasurementError, match="empty.csv: no rows"):
        read_measurement(tmp_path / "empty.csv")
    (tmp_path / "image.csv").write_bytes(bytes(range(256)))
    with pytest.raises(MeasurementError, match="image.csv: cannot be read as text"):
        read_measurement(tmp_path / "image.csv")


def test_constant_columns_and_gaps_are_named():
    time = np.arange(60.0)
    rows = np.arange(60) + 2
    constant = Measurement("a.csv", time, np.ones(60), time, None, None, rows)
    with pytest.raises(MeasurementError, match="column 'voltage' is 1 in all rows 2 to 61"):
        constant.need_varying("deflection", "voltage")
    with pytest.raises(MeasurementError, match="no column 'tip_force'"):
        constant.need_varying("tip_force")
    time = np.where(time < 10, time, time + 1)
    gap = Measurement("a.csv", time, time, time, None, None, rows)
    with pytest.raises(MeasurementError, match="column 'time', row 12 is 11: 2 s after"):
        gap.need_even_sampling()


@pytest.mark.parametrize("sensor_delay", [0, 1, 3])
def test_bag_pairs_deflections_with_the_voltage_before_them(tmp_path, sensor_delay):
    """A plant that answers at once: deflection k shows voltage k - 1 - delay, and 0 V before."""
    voltage = np.random.default_rng(1).uniform(-40.0, 40.0, 60)
    deflection = 5e-7 * np.concatenate((np.zeros(1 + sensor_delay), voltage))[:60]
    path = write_bag(tmp_path / "bag", voltage, deflection, temperature=22.0 + np.arange(60))
    measurement = read_measurement(path, sensor_delay=sensor_delay)
    np.testing.assert_allclose(measurement.deflection, 5e-7 * measurement.voltage, atol=1e-18)
    assert measurement.sample_time == pytest.approx(1e-3)
    assert measurement.temperature[-1] == 22.0 + 59 - 1 - sensor_delay


def test_unusable_bags_are_refused(tmp_path):
    voltage = np.arange(60.0)
    with pytest.raises(MeasurementError, match=str(tmp_path)):
        read_measurement(tmp_path)
    lost = np.where((voltage == 17) | (voltage == 18), np.nan, voltage)
    path = write_bag(tmp_path / "nan", voltage, lost)
    words = "4 of 60 samples .*2 in between, without deflection.*rosbag2_qos.yaml"
    with pytest.raises(MeasurementError, match=words):
        read_measurement(path)


def test_few_lost_samples_of_a_bag_are_left_out_and_counted(tmp_path):
    """A deflection that is lost, and the one two samples after a voltage that is: the rest stays paired."""
    voltage = np.random.default_rng(1).uniform(-40.0, 40.0, 1000)
    deflection = 5e-7 * np.concatenate((np.zeros(2), voltage))[:1000]
    deflection[300] = np.nan
    measurement = read_measurement(write_bag(tmp_path / "bag", voltage[:990], deflection))
    kept = np.setdiff1d(np.arange(990), [300, 302])  # voltage 300 was left out with its deflection
    np.testing.assert_array_equal(measurement.rows, kept)
    np.testing.assert_allclose(measurement.deflection, 5e-7 * measurement.voltage, atol=1e-18)
    assert "10 at the end, without voltage; 1 in between, without deflection" in (
        measurement.description
    )
