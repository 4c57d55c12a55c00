# SPDX-License-Identifier: Apache-2.0
"""Measurements that nothing can be identified from: each is refused by name, and a good one by none."""

import numpy as np
import pytest

from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification import checks
from piezo_control.identification.dynamics import DynamicsModel, identify_dynamics
from piezo_control.identification.measurement import (
    Measurement,
    MeasurementError,
    read_measurement,
)

RATE = 200.0  # Hz
TIME = np.arange(2000) / RATE
VOLTAGE = 40.0 * np.sin(2.0 * np.pi * TIME)
OPERATOR = HysteresisParameters((0.0, 5.0, 12.0), (4e-7, 1.2e-7, 8e-8))
DEFLECTION = deflection_history(OPERATOR, VOLTAGE)
STROKE = float(np.ptp(DEFLECTION))


def measured(deflection=DEFLECTION, voltage=VOLTAGE, time=TIME):
    return Measurement("a.csv", time, voltage, deflection, None, None, np.arange(len(time)) + 2)


def white(deviation, seed=1):
    return np.random.default_rng(seed).normal(0.0, deviation, TIME.size)


GOOD = {
    "a loop": measured(),
    "a linear finger": measured(5e-7 * VOLTAGE),
    "with noise of 1 %": measured(DEFLECTION + white(0.01 * STROKE)),
    "late by a twentieth of a period": measured(np.roll(DEFLECTION, 10)),
    "with an offset and some drift": measured(DEFLECTION - 1e-4 + 0.04 * STROKE * TIME / TIME[-1]),
    "a triangle": measured(deflection_history(OPERATOR, np.interp(TIME % 1.0, [0, 0.25, 0.75, 1], [0, 40, -40, 0])),
                           np.interp(TIME % 1.0, [0, 0.25, 0.75, 1], [0, 40, -40, 0])),
    "held at the ends": measured(deflection_history(OPERATOR, np.clip(1.3 * VOLTAGE, -40, 40)), np.clip(1.3 * VOLTAGE, -40, 40)),
    "decaying": measured(deflection_history(OPERATOR, VOLTAGE * (1 - TIME / 11)), VOLTAGE * (1 - TIME / 11)),
    "digits of 1/200 of the stroke": measured(np.round(DEFLECTION / STROKE, 2) * STROKE),
}  # fmt: skip
FAST = slice(0, None, 17)  # 11.8 samples in a period
BAD = {
    "the sign of the sensor is reversed": measured(-DEFLECTION),
    "rows 28 to 81 stay at 1.*e-05 m while the voltage moves": measured(
        np.minimum(DEFLECTION, 0.7 * DEFLECTION.max())
    ),
    "stay at -1.*e-05 m while the voltage moves": measured(
        np.maximum(DEFLECTION + white(1e-3 * STROKE), 0.8 * DEFLECTION.min())
    ),
    "stay at 28 V while the deflection goes on": measured(voltage=np.minimum(VOLTAGE, 28.0)),
    "stay at -28 V while the deflection goes on": measured(voltage=np.maximum(VOLTAGE, -28.0)),
    "has 12 samples in a period of 1.02 s, must be at least 20": measured(
        DEFLECTION[FAST], VOLTAGE[FAST], TIME[FAST]
    ),
    "moves by .* µm under noise of .*: too small an excursion": measured(
        0.05 * DEFLECTION + white(0.01 * STROKE)
    ),
    "has 11 different values .*: too small an excursion for the resolution": measured(
        np.round(DEFLECTION / STROKE, 1) * STROKE
    ),
    "drifts by .* µm from cycle to cycle, the loop is": measured(DEFLECTION + STROKE * TIME / TIME[-1]),
}  # fmt: skip


@pytest.mark.parametrize("measurement", GOOD.values(), ids=GOOD)
def test_a_good_measurement_is_refused_by_nothing(measurement):
    checks.static(measurement)
    assert measurement.clock() == []
    assert checks.hum(measurement, measurement.deflection - DEFLECTION) == ""


@pytest.mark.parametrize("words", BAD)
def test_a_bad_one_is_refused_by_name(words):
    with pytest.raises(MeasurementError, match=f"a.csv: .*{words}"):
        checks.static(BAD[words])


def test_the_hum_of_the_mains_is_found_and_measured():
    deviation = 0.01 * STROKE * np.sin(2.0 * np.pi * 50.0 * TIME + 1.0) + white(0.005 * STROKE)
    said = checks.hum(measured(), deviation)
    assert said.startswith("mains hum in column 'deflection': 50 Hz of ")
    assert float(said.split("of ")[1].split(" µm")[0]) == pytest.approx(
        0.01 * STROKE * 1e6, rel=0.1
    )
    assert checks.hum(measured(), white(0.05 * STROKE)) == ""


def text(path, time, digits=4):
    rows = np.column_stack((time, VOLTAGE[: time.size], 1e6 * DEFLECTION[: time.size]))
    np.savetxt(
        path, rows, fmt=f"%.{digits}f", delimiter=",", comments="",
        header="time,voltage,deflection_um",
    )  # fmt: skip
    return path


def test_gaps_are_counted_and_too_many_refused(tmp_path):
    few = np.delete(TIME, [500, 501, 900])
    assert "3 rows are missing in 2 gaps, the first before row 502" in (
        read_measurement(text(tmp_path / "few.csv", few)).description
    )
    with pytest.raises(
        MeasurementError,
        match="'time', row 502 is 3: 0.505 s after the row before, rows come every 0.005 s: 100 rows are missing",
    ):
        read_measurement(text(tmp_path / "many.csv", np.delete(TIME, range(500, 600))))


def test_clocks_are_judged(tmp_path):
    """Repeated, backward, jittering; and the sample rate in the place of such a clock."""
    coarse = text(tmp_path / "coarse.csv", TIME, digits=2)
    with pytest.raises(MeasurementError, match="rows repeat a time; .* --sample-rate 200"):
        read_measurement(coarse)
    np.testing.assert_allclose(read_measurement(coarse, sample_time=0.005).time, TIME, atol=1e-9)
    back = np.concatenate((TIME[:1000], TIME[:1000]))
    with pytest.raises(
        MeasurementError, match="row 1002 is 0: not after 4.995 .*the time goes back"
    ):
        read_measurement(text(tmp_path / "back.csv", back))
    jitter = TIME + np.random.default_rng(2).uniform(-3e-4, 3e-4, TIME.size)
    said = read_measurement(text(tmp_path / "jitter.csv", jitter, digits=6)).description
    assert "the time between rows varies by 4.9 %" in said and "--sample-rate 200" in said


def test_a_few_missing_rows_are_bridged_by_straight_lines():
    kept = np.delete(np.arange(TIME.size), [500, 501, 900])
    whole = measured(DEFLECTION[kept], VOLTAGE[kept], TIME[kept]).bridged()
    np.testing.assert_allclose(np.diff(whole.time), 0.005, atol=1e-12)
    np.testing.assert_allclose(whole.voltage[kept], VOLTAGE[kept], atol=1e-12)
    np.testing.assert_allclose(
        whole.voltage, VOLTAGE, atol=0.06
    )  # curvature within 15 ms of the sine
    whole.need_even_sampling()
    assert measured().bridged().time is TIME


RINGING_TIME = np.arange(800) * 1e-4
STEP = np.where(RINGING_TIME < 2e-3, 0.0, 40.0)
RINGING = DynamicsModel(2.0 * np.pi * 300.0, 0.02, 5.5e-7, 0.0, 0.0, 0).deflection(
    RINGING_TIME, STEP
)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_vibration_that_stops_at_the_end_of_a_sensor_is_refused(side):
    """300 Hz, 33 samples in a period: 10 % of the first swing are cut off, 7 samples of it."""
    noise = np.random.default_rng(1).normal(0.0, 2e-9, RINGING.size)
    whole = measured(side * RINGING + noise, STEP, RINGING_TIME)
    checks.clipped(whole)
    cut = side * np.minimum(RINGING, 0.9 * RINGING.max()) + noise
    with pytest.raises(
        MeasurementError, match="a.csv: .*rows .* stay at .*the sensor is at its end"
    ):
        checks.clipped(measured(cut, STEP, RINGING_TIME))


def test_even_sampling_with_few_digits_of_time_is_even():
    """3 and 30 kHz, time written to the microsecond: steps of 333 and 334, of 33 and 34 µs."""
    kept = np.delete(np.arange(TIME.size), [500, 501, 900])
    for rate in (3e3, 3e4):
        time = np.round(np.arange(TIME.size) / rate, 6)
        even = measured(time=time)
        even.need_even_sampling()
        assert even.sample_time == pytest.approx(1.0 / rate, rel=1e-4)
        assert even.bridged() is even and even.clock() == []
        few = measured(DEFLECTION[kept], VOLTAGE[kept], time[kept])
        assert few.clock() == ["3 rows are missing in 2 gaps, the first before row 502"]
        with pytest.raises(MeasurementError, match="row 502 is .* after the row before"):
            few.need_even_sampling()
        whole = few.bridged()
        np.testing.assert_allclose(whole.time, time, atol=1.1e-6)
        whole.need_even_sampling()
        shifted = 1e5 + time  # where a double has digits of 15 ps
        measured(time=shifted).need_even_sampling()
        late = time + np.where(np.arange(TIME.size) == 700, 4e-6, 0.0)
        with pytest.raises(MeasurementError, match=f"--sample-rate {rate:.0f}"):
            measured(time=late).need_even_sampling()


def test_a_late_row_is_no_digit_of_the_clock():
    """One step of 7 ms among those of 5 ms: no clock of 2 ms, which has no 5."""
    late = measured(time=TIME + np.where(np.arange(TIME.size) > 700, 2e-3, 0.0))
    with pytest.raises(MeasurementError, match="row 703 is .*: 0.007 s after the row before"):
        late.need_even_sampling()


def test_a_clock_as_coarse_as_the_rows_may_be_replaced(tmp_path):
    """100 Hz in single precision 1e5 s after the clock's begin, a digit is 1/128 s, of 20 s: 99.99 is as near as it tells."""
    time = (1e5 + np.arange(TIME.size) / 100.0).astype(np.float32)
    with pytest.raises(
        MeasurementError, match="rows are missing in .*coarse, --sample-rate 99.989 in"
    ):
        measured(time=time.astype(float)).clock()


def test_a_resonance_seen_by_a_clock_of_few_digits_is_where_it_is():
    """900 Hz at 30 kHz: the samples are a model's at the exact times, the clock rounds them."""
    time = np.arange(3000) / 3e4
    step = np.where(time < 0.01, 0.0, 20.0)
    ringing = DynamicsModel(2.0 * np.pi * 900.0, 0.02, 5e-7, 0.0, 0.0, 0).deflection(time, step)
    seen = measured(ringing, step, np.round(time, 6)).bridged()
    found = identify_dynamics(seen, step, 1)
    assert found.natural_frequency / (2.0 * np.pi) == pytest.approx(900.0, rel=1e-3)
    np.testing.assert_allclose(found.deflection(seen.time, step), ringing, atol=2e-8)
