# SPDX-License-Identifier: Apache-2.0
"""Figures of merit against closed forms of responses that can be written down."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezo_control import metrics

H = 1e-4


def first_order(time, time_constant, gain=1.0):
    return gain * (1.0 - np.exp(-time / time_constant))


@given(st.floats(1e-3, 2e-2), st.floats(0.9, 1.1), st.floats(1e-6, 1e-4))
def test_step_of_a_first_order_lag(time_constant, gain, height):
    # 1 - exp(-t/T) enters 5 % and 2 % at T ln 20 and T ln 50 and rises from 10 to 90 % in T ln 9.
    time = np.arange(0.0, 15 * time_constant, time_constant / 500)
    found = metrics.step_metrics(time, height * first_order(time, time_constant, gain), height)
    spacing = time_constant / 500
    assert found.settling_5_final_s == pytest.approx(time_constant * np.log(20), abs=2 * spacing)
    assert found.settling_2_final_s == pytest.approx(time_constant * np.log(50), abs=2 * spacing)
    assert found.rise_s == pytest.approx(time_constant * np.log(9), rel=1e-3)
    assert found.static_error == pytest.approx(abs(1 - gain), abs=1e-5)
    assert found.overshoot == pytest.approx(max(0.0, gain - 1.0), abs=1e-5)


def test_settling_never_comes_when_the_last_sample_is_outside():
    time = np.arange(5) * H
    assert metrics.settling_time(time, [0, 1, 1, 1, 0], 1.0, 0.1) == np.inf
    assert metrics.settling_time(time, [0, 1, 0, 1, 1], 1.0, 0.1) == pytest.approx(3 * H)


@given(st.floats(200.0, 1500.0), st.floats(0.005, 0.05))
def test_ringing_of_a_damped_vibration(frequency_hz, ratio):
    # 1 - exp(-zeta w t) cos(wd t), wd = w sqrt(1 - zeta^2)
    omega = 2 * np.pi * frequency_hz
    time = np.arange(0.0, 6.0 / (ratio * omega), 0.04 / frequency_hz)
    damped = omega * np.sqrt(1 - ratio**2)
    found = metrics.ringing(time, 1 - np.exp(-ratio * omega * time) * np.cos(damped * time))
    assert found.frequency_hz == pytest.approx(damped / (2 * np.pi), rel=2e-3)
    assert found.damping_ratio == pytest.approx(ratio, rel=0.03)


def test_ringing_needs_a_vibration():
    time = np.arange(500) * H
    with pytest.raises(ValueError, match="half-waves"):
        metrics.ringing(time, first_order(time, 5e-3))


def test_drift_of_a_ramp():
    time = np.arange(0.0, 10.0, 0.01)
    # means over 1 s from 2 s on and of the last second: centres 2.495 s and 9.495 s
    assert metrics.drift(time, 3.0 * time, begin=2.0, average=1.0) == pytest.approx(21.0, rel=1e-6)


@given(st.floats(0.02, 0.5), st.floats(0.1, 10.0))
def test_loop_of_a_delayed_sine(phase, gain):
    # y = g sin(wt - p) over sin(wt): an ellipse, 2 g sin(p) high in the middle, of slope g cos(p).
    angle = np.linspace(0.0, 4 * np.pi, 8001)
    drive, value = np.sin(angle), gain * np.sin(angle - phase)
    cycle = metrics.last_cycle(drive)
    assert angle[cycle.start] == pytest.approx(np.pi / 2, abs=1e-3)
    assert angle[cycle.stop - 1] == pytest.approx(5 * np.pi / 2, abs=1e-3)
    found = metrics.loop_metrics(drive[cycle], value[cycle])
    assert found.width == pytest.approx(2 * gain * np.sin(phase), rel=0.01)
    assert found.relative_width == pytest.approx(np.sin(phase), rel=0.01)
    assert found.slope == pytest.approx(gain * np.cos(phase), rel=2e-3)
    assert found.peak_to_peak == pytest.approx(2 * gain, rel=1e-5)


def test_half_a_cycle_is_refused():
    with pytest.raises(ValueError, match="1 maxima"):
        metrics.last_cycle(np.sin(np.linspace(0, np.pi, 100)))


POLE = 226.0  # rad/s


def low_pass(drive):
    """y' = POLE (u - y) with u held: exact samples, and the exact response at the lines."""
    kept = np.exp(-POLE * H)
    value = np.zeros(drive.size)
    for k in range(drive.size - 1):
        value[k + 1] = kept * value[k] + (1 - kept) * drive[k]
    return value


def low_pass_response(omega):
    z = np.exp(1j * omega * H)
    kept = np.exp(-POLE * H)
    return (1 - kept) / (z - kept)


def test_response_at_the_lines_of_a_multisine():
    period = 4000
    time = np.arange(2 * period) * H
    lines = np.array([1, 5, 17, 60, 200, 900])
    drive = sum(np.cos(2 * np.pi * n * np.arange(2 * period) / period + n) for n in lines)
    found = metrics.frequency_response(time, drive, low_pass(drive))
    omega = 2 * np.pi * lines / (period * H)
    np.testing.assert_allclose(found.frequency, omega, rtol=1e-9)
    np.testing.assert_allclose(found.gain, low_pass_response(omega), rtol=1e-6)


def test_response_and_band_from_noise():
    rng = np.random.Generator(np.random.PCG64(1))
    drive = rng.standard_normal(80_000)
    time = np.arange(drive.size) * H
    found = metrics.frequency_response(time, drive, low_pass(drive))
    inside = (found.frequency > 20.0) & (found.frequency < 2000.0)
    expected = low_pass_response(found.frequency[inside])
    assert np.max(np.abs(found.gain[inside] / expected - 1)) < 0.05
    # |1 / (1 + jw/p)| is -3 dB at p sqrt(10^0.3 - 1)
    assert metrics.bandwidth(found) == pytest.approx(POLE * np.sqrt(10**0.3 - 1), rel=0.03)


def test_band_is_interpolated_and_may_be_missing():
    response = metrics.FrequencyResponse(np.array([1.0, 10.0, 1000.0]), np.array([1.0, 1.0, 0.5]))
    # straight in dB over log(w): -3 dB lies at the fraction 3 / 6.0206 of the two decades
    expected = 10 ** (1 + 2 * 3 / (20 * np.log10(2)))
    assert metrics.bandwidth(response) == pytest.approx(expected, rel=1e-9)
    assert metrics.bandwidth(response, -10.0) == np.inf


def test_disturbance_that_is_rejected():
    time = np.arange(0.0, 1.0, H)
    since = time - 0.3
    disturbance = np.where(time >= 0.3 - H / 2, 10.0, 0.0)
    value = 5.0 + np.where(since > 0, 2.0 * np.exp(-since / 0.05), 0.0)
    found = metrics.disturbance_metrics(time, value, disturbance)
    assert found.change == 10.0
    assert found.excursion == pytest.approx(2.0, rel=0.01)
    assert found.rejection == pytest.approx(0.2, rel=0.01)
    assert found.remaining == pytest.approx(0.0, abs=1e-5)
    assert found.recovery_s == pytest.approx(0.05 * np.log(20), abs=3e-4)
    averaged = metrics.disturbance_metrics(time, value, disturbance, average=0.01)
    # mean of exp(-t/T) over the first 10 ms
    assert averaged.excursion == pytest.approx(2.0 * 5 * (1 - np.exp(-0.2)), rel=0.01)


def test_constant_disturbance_is_refused():
    with pytest.raises(ValueError, match="does not change"):
        metrics.disturbance_metrics(np.arange(5) * H, np.ones(5), np.ones(5))
