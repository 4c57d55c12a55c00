# SPDX-License-Identifier: Apache-2.0
"""The linear loop against independent simulation, closed forms and python-control."""

import math
from pathlib import Path

import control
import numpy as np
import pytest
import scipy.signal

from piezo_control.design.linear_loop import (
    closed_loop,
    controller_response,
    finger_response,
    fingers,
    margins,
    noise_gain,
    open_loop,
    respond,
    settling,
    spectral_radius,
    static_gain,
)
from piezo_control.design.problem import FingerModel
from piezo_control.dynamics import ModesParameters
from piezo_control.feedback import Feedback, FeedbackParameters
from piezo_control.metrics import settling_time
from piezo_control.parameters import build, load

ROBUST = Path(__file__).resolve().parents[1] / "params" / "feedback_robust.yaml"
DENOMINATOR = (5.7e-8, 8.1e-6, 1.0)
STEP = 1e-4


def robust() -> FeedbackParameters:
    return build(FeedbackParameters, load(ROBUST, "feedback"), str(ROBUST))


@pytest.mark.parametrize(
    "damping", [1.0, 1.0 / 0.01696, 100.0], ids=["ringing", "critical", "slow"]
)
def test_finger_is_the_exact_hold_equivalent(damping):
    box = fingers(FingerModel(delay_samples=2), resonance=[0.9], damping=[damping], gain=[1.1])
    a2, a1, _ = DENOMINATOR
    numerator, denominator, _ = scipy.signal.cont2discrete(
        ([1.1], [a2 / 0.9**2, a1 * damping / 0.9, 1.0]), STEP, "zoh"
    )
    z = np.exp(1j * np.linspace(1.0, math.pi / STEP, 50) * STEP)
    expected = np.polyval(numerator[0], z) / np.polyval(denominator, z) / z**2
    np.testing.assert_allclose(finger_response(box, z)[0], expected, rtol=1e-6)


def test_modes_and_amplifier_against_scipy():
    """(1 - s) D_1 + s_2 D_2 + s_3 D_3, sampled as one transfer function, behind a first-order lag."""
    model = FingerModel(
        modes=ModesParameters(frequency_hz=(4178.0,), damping=(0.017,), share=(0.08,)),
        amplifier_bandwidth_hz=3000.0,
        delay_samples=3,
    )
    beside = [
        ModesParameters(frequency_hz=(2500.0,), damping=(0.02,), share=(share,))
        for share in (-0.1, 0.1)
    ]
    box = fingers(model, gain=[0.9], beside=beside)
    z = np.exp(1j * np.linspace(1.0, 0.99 * math.pi / STEP, 60) * STEP)
    left = math.exp(-2.0 * math.pi * 3000.0 * STEP)
    for i, share in enumerate((-0.1, 0.1)):
        numerator, denominator = np.zeros(1), np.ones(1)
        for part, hertz, zeta in (
            (
                1.0 - 0.08 - share,
                1.0 / math.sqrt(5.7e-8) / 2.0 / math.pi,
                8.1e-6 / 2.0 / math.sqrt(5.7e-8),
            ),
            (0.08, 4178.0, 0.017),
            (share, 2500.0, 0.02),
        ):
            w = 2.0 * math.pi * hertz
            mode = scipy.signal.cont2discrete(
                ([part], [1.0 / w**2, 2.0 * zeta / w, 1.0]), STEP, "zoh"
            )
            numerator = np.polyadd(
                np.polymul(numerator, mode[1]), np.polymul(mode[0][0], denominator)
            )
            denominator = np.polymul(denominator, mode[1])
        expected = 0.9 * np.polyval(numerator, z) / np.polyval(denominator, z)
        expected *= (1.0 - left) / (1.0 - left / z) / z**3
        np.testing.assert_allclose(finger_response(box, z)[i], expected, rtol=1e-6)
        way = open_loop(box)
        for j in (0, 20, 59):
            resolvent = np.linalg.solve(z[j] * np.eye(len(way.c)) - way.a[i], way.b[i])
            assert way.c @ resolvent == pytest.approx(expected[j], rel=1e-6)


def test_noise_gain_is_the_scatter_of_a_long_run():
    controller = robust()
    box = fingers(FingerModel(), gain=[1.1])
    random = np.random.default_rng(1)
    state, feedback, reading, found = np.zeros(2), Feedback(controller), 0.0, []
    for noise in 1e-9 * random.standard_normal(20000):
        found.append(feedback.step(0.0, reading + noise))
        reading = state[0]
        state = box.a[0, 0] @ state + box.b[0, 0] * found[-1]
    expected = float(noise_gain(closed_loop(box, controller))[0])
    assert np.std(found) * 1e9 == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("delay", [0, 1, 3])
@pytest.mark.parametrize("source", ["reference", "force", "drift"])
def test_responses_equal_the_laws_stepped_sample_by_sample(delay, source):
    controller = robust()
    box = fingers(FingerModel(delay_samples=delay), resonance=[0.9, 1.1], damping=[0.5], gain=[1.1])
    lag = 0.3 if source == "drift" else 0.0
    found = respond(closed_loop(box, controller), source, 120, lag, STEP)
    for i in range(2):
        # Signals of 1 µm stay within the limits of the command.
        feedback = Feedback(controller)
        state = np.zeros(2)
        readings = [0.0] * delay
        for k in range(120):
            signal = 1e-6 * (1.0 - math.exp(-k * STEP / lag) if lag else 1.0)
            readings.append(state[0] + (signal if source == "drift" else 0.0))
            assert found[i, k] == pytest.approx(readings[k] * 1e6, abs=1e-9)
            command = feedback.step(signal if source == "reference" else 0.0, readings[k])
            force = signal if source == "force" else 0.0
            state = box.a[i, 0] @ state + box.b[i, 0] * command + box.b_force[i, 0] * force


def test_poles_and_static_gain_equal_python_control():
    controller = robust()
    box = fingers(FingerModel())
    z = control.tf([1, 0], [0, 1], STEP)
    g = control.ss(box.a[0, 0], box.b[0, 0][:, None], [[1, 0]], 0, STEP) * control.ss(1 / z)
    p = controller
    k = control.ss(p.matrix("a"), p.matrix("b")[:, None], [p.c], p.d, STEP)
    loop = closed_loop(box, controller)
    expected = np.abs(control.feedback(g * k).poles()).max()
    assert spectral_radius(loop)[0] == pytest.approx(expected, abs=1e-6)
    assert static_gain(loop)[0] == pytest.approx(1.0, abs=1e-9)
    omega = np.array([10.0, 1e3, 4188.0, 2e4])
    np.testing.assert_allclose(
        controller_response(controller, np.exp(1j * omega * STEP))[0],
        k(np.exp(1j * omega * STEP)),
        rtol=1e-6,
    )


def test_margins_of_a_triple_lag():
    # L = 4 / (s + 1)³: L = -1/2 at w = sqrt 3, so the gain margin is 2; |L| = 1 at
    # w = sqrt(4^(2/3) - 1), where the phase is -3 atan w (Franklin, Powell, Emami-Naeini, ch. 6).
    frequency = np.geomspace(1e-2, 1e2, 20001)
    found = margins(frequency, 4.0 / (1j * frequency + 1.0) ** 3)
    crossing = math.sqrt(4.0 ** (2.0 / 3.0) - 1.0)
    phase = math.pi - 3.0 * math.atan(crossing)
    assert found.gain_up == pytest.approx(2.0, rel=1e-6)
    assert found.gain_down == 0.0
    assert found.phase_deg == pytest.approx(math.degrees(phase), rel=1e-5)
    assert found.delay_s == pytest.approx(phase / crossing, rel=1e-5)


def test_margins_of_a_conditionally_stable_loop_equal_python_control():
    # Two real-axis crossings left of the origin, one on either side of -1.
    s = control.tf("s")
    loop = 3.0 * (s + 1.0) ** 2 / s**3
    frequency = np.geomspace(1e-2, 1e3, 50001)
    found = margins(frequency, loop(1j * frequency))
    gain, phase, _, _, _, _ = control.stability_margins(loop)
    assert gain < 1.0
    assert found.gain_down == pytest.approx(gain, rel=1e-6)
    assert found.gain_up == math.inf
    assert found.phase_deg == pytest.approx(phase, rel=1e-4)


def test_settling_agrees_with_the_metric_to_a_sample():
    time = np.arange(200) * STEP
    readings = 1.0 - np.exp(-time / 3e-3) * np.cos(time * 2000.0)
    found = settling(np.array([readings, 0.0 * time, 1.0 + 0.0 * time]), STEP, 1.0, 0.05)
    metric = settling_time(time, readings, 1.0, 0.05)
    assert metric - STEP <= found[0] <= metric
    assert found[1] == math.inf
    assert found[2] == 0.0
