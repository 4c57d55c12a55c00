# SPDX-License-Identifier: Apache-2.0
"""Figures of responses against closed forms."""

import math

import numpy as np
import pytest

from piezo_control.metrics import (
    bandwidth,
    disturbance_metrics,
    drift,
    frequency_response,
    loop_metrics,
    ringing,
    rms,
    settling_time,
    step_metrics,
)

TIME = np.arange(0, 0.1, 1e-4)


def test_first_order_step():
    # 20 µm (1 - exp(-t/tau)): 5 % after tau ln 20, 2 % after tau ln 50, rise tau ln 9.
    tau = 4e-3
    m = step_metrics(TIME, 20e-6 * -np.expm1(-TIME / tau), 20e-6)
    sample = TIME[1]
    assert 0.0 <= m.settling_5_reference_s - tau * math.log(20) < sample
    assert 0.0 <= m.settling_2_reference_s - tau * math.log(50) < sample
    assert m.settling_5_final_s == m.settling_5_reference_s
    assert m.rise_s == pytest.approx(tau * math.log(9), rel=1e-3)
    assert m.overshoot == 0.0
    assert m.static_error < 1e-8
    assert m.final == pytest.approx(20e-6, rel=1e-8)


def test_second_order_overshoot_and_a_downward_step_from_elsewhere():
    # Overshoot exp(-pi zeta / sqrt(1 - zeta²)): 16.3 % for zeta = 0.5; same for a step down.
    zeta, omega = 0.5, 1000.0
    ringing_omega = omega * math.sqrt(1 - zeta**2)
    progress = 1 - np.exp(-zeta * omega * TIME) * (
        np.cos(ringing_omega * TIME) + zeta * omega / ringing_omega * np.sin(ringing_omega * TIME)
    )
    expected = math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    up = step_metrics(TIME, progress, 1.0)
    down = step_metrics(TIME, 5.0 - 3.0 * progress, 2.0, initial=5.0)
    assert up.overshoot == pytest.approx(expected, rel=2e-3)
    assert down == pytest.approx(up._replace(final=2.0), rel=1e-6)


def test_a_static_error_counts_against_the_reference_not_the_final_value():
    # Final value 0.94: it never comes within 5 % of the reference, but of itself at once.
    m = step_metrics(TIME, np.full_like(TIME, 0.94), 1.0)
    assert m.settling_5_reference_s == math.inf
    assert m.settling_5_final_s == 0.0
    assert m.static_error == pytest.approx(0.06)


def test_settling_is_for_good_and_infinite_outside():
    assert settling_time([0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 0.0, 1.0], 1.0, 0.1) == 3.0
    assert settling_time([1.0, 2.0], [1.0, 0.0], 1.0, 0.1) == math.inf
    assert settling_time([1.0, 2.0], [1.0, math.nan], 1.0, 0.1) == math.inf
    assert settling_time([1.0, 2.0], [1.0, 1.0], 1.0, 0.1) == 0.0


def test_refuses_no_step_and_unequal_arrays():
    with pytest.raises(ValueError, match="there is no step"):
        step_metrics(TIME, TIME, 1.0, initial=1.0)
    with pytest.raises(ValueError, match="must be 1-D, as long as"):
        step_metrics(TIME, TIME[:-1], 1.0)


def test_ringing_of_a_damped_vibration():
    omega, zeta = 2 * math.pi * 666.6, 0.017
    time = np.arange(0, 0.15, 1e-5)
    value = np.exp(-zeta * omega * time) * np.cos(omega * math.sqrt(1 - zeta**2) * time)
    found = ringing(time, value)
    assert found.frequency_hz == pytest.approx(666.6 * math.sqrt(1 - zeta**2), rel=1e-4)
    assert found.damping_ratio == pytest.approx(zeta, rel=1e-2)
    with pytest.raises(ValueError, match="needs 4 or more"):
        ringing(TIME, np.exp(-TIME / 1e-2))


def test_drift_between_two_averages():
    # A ramp of 2 per second from 10 ms on: the averages' centres are 10.5 ms and 99.45 ms.
    assert drift(TIME, 2.0 * TIME, 0.01, 1e-3) == pytest.approx(2.0 * (0.0994 - 0.01045), abs=2e-4)


def test_loop_of_an_ellipse():
    # sin(t - phase) over sin(t): width 2 sin(phase), least squares slope cos(phase).
    phase = np.linspace(0, 4 * np.pi, 4001)
    drive, value = np.sin(phase), np.sin(phase - 0.1)
    top = slice(500, 2501)
    found = loop_metrics(drive[top], value[top])
    assert found.width == pytest.approx(2 * math.sin(0.1), rel=1e-3)
    assert found.relative_width == pytest.approx(math.sin(0.1), rel=1e-3)
    assert found.slope == pytest.approx(math.cos(0.1), rel=1e-3)
    assert found.peak_to_peak == pytest.approx(2.0, rel=1e-5)


def test_frequency_response_and_bandwidth_of_a_lag():
    # y' = omega (u - y) sampled with a hold: gain (1 - a) / (z - a), a = exp(-omega h).
    h, omega = 1e-3, 50.0
    rng = np.random.default_rng(3)
    half = rng.standard_normal(4096)
    drive = np.concatenate([half, half])
    value = np.zeros_like(drive)
    decay = math.exp(-omega * h)
    for k in range(1, drive.size):
        value[k] = decay * value[k - 1] + (1 - decay) * drive[k - 1]
    found = frequency_response(np.arange(drive.size) * h, drive, value)
    z = np.exp(1j * found.frequency * h)
    assert np.abs(found.gain - (1 - decay) / (z - decay)).max() < 1e-9
    assert bandwidth(found) == pytest.approx(omega, rel=0.02)


def test_disturbance_that_is_rejected():
    time = np.arange(0, 1.0, 1e-3)
    since = np.maximum(time - 0.2, 0.0)
    disturbance = np.where(time >= 0.2, 10.0, 0.0)
    value = 3.0 + 2.0 * since / 0.05 * np.exp(1.0 - since / 0.05)  # peak of 2 after 50 ms
    found = disturbance_metrics(time, value, disturbance)
    assert found.change == 10.0
    assert found.excursion == pytest.approx(2.0, rel=1e-6)
    assert found.rejection == pytest.approx(0.2, rel=1e-6)
    assert abs(found.remaining) < 1e-3
    # t/tau exp(1 - t/tau) = 0.05 at t = 5.744 tau (solution of x - ln x = 1 - ln 0.05).
    assert found.recovery_s == pytest.approx(5.744 * 0.05, abs=2e-3)


def test_rms_of_a_sine():
    assert rms(3.0 * np.sin(np.arange(1000) * 2 * np.pi / 100)) == pytest.approx(3 / math.sqrt(2))
