# SPDX-License-Identifier: Apache-2.0
"""Shapers against the mode that they are for, stepped exactly."""

import time

import numpy as np
import pytest

from piezo_control import shaping
from piezo_control.dynamics import DynamicsParameters, Motion, move, propagator
from piezo_control.parameters import ParameterError
from piezo_control.profile import Profile
from piezo_control.shaping import (
    ShapingParameters,
    ahead,
    delay,
    longest,
    residual_vibration,
    shape,
    shaper,
)

H = 1e-4
A2, A1, _ = DENOMINATOR = DynamicsParameters().denominator
KINDS = ("zero_vibration", "robust", "least_time")


def vibration_after_a_step(taps, resonance=1.0, damping=1.0):
    """Amplitude of what still moves at the last tap, relative to that of an unshaped step at once."""
    a2, a1 = A2 / resonance**2, A1 * damping / resonance
    free = propagator(a2, a1, 1.0, H)
    amplitudes = []
    for each in (taps, [1.0]):
        motion, past = Motion([0.0], [0.0]), [0.0] * longest(each, 1.0)
        for _ in range(len(taps)):
            move(motion, free, shape(each, past, 1.0, 1.0))
        # The complex amplitude of the mode with the poles p, p*: (v - conj(p) (x - 1)) / (p - conj(p))
        pole = complex(-0.5 * a1 / a2, np.sqrt(1.0 / a2 - (0.5 * a1 / a2) ** 2))
        amplitudes.append(abs(motion.v[0] - pole.conjugate() * (motion.x[0] - 1.0)))
    return amplitudes[0] / amplitudes[1] * np.exp(-0.5 * a1 / a2 * H * (len(taps) - 1))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("resonance, damping", [(0.9, 0.5), (0.97, 1.0), (1.0, 1.5), (1.1, 1.0)])
def test_the_residual_is_what_the_mode_does(kind, resonance, damping):
    taps = shaper(ShapingParameters(kind=kind), DENOMINATOR, H)
    frequency = resonance / (2.0 * np.pi * np.sqrt(A2))
    ratio = damping * 0.5 * A1 / np.sqrt(A2)
    expected = residual_vibration(taps, frequency, ratio, H)
    assert vibration_after_a_step(taps, resonance, damping) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_taps_sum_to_1_and_none_is_negative(kind):
    taps = np.array(shaper(ShapingParameters(kind=kind), DENOMINATOR, H))
    assert np.sum(taps) == pytest.approx(1.0, abs=1e-12)
    assert np.min(taps) >= 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_profile_that_is_known_ahead_is_reached_at_the_end_of_its_sample(kind):
    """Exactly on straight lines; around a bend is left what the shaper misses of its miss, twice but for two taps."""
    taps = np.array(shaper(ShapingParameters(kind=kind), DENOMINATOR, H))
    bend = Profile([0.0, 0.02, 0.04], [0.0, 0.0, 1.0], linear=True)
    plan = ahead(bend, 0.0, 0.04, taps, H)
    past = [0.0] * longest(taps, 1.0)
    reached = np.array([shape(taps, past, plan.at(k * H), 1.0) for k in range(400)])
    end = H * np.arange(1, 401)
    span = len(taps) * H
    far = (np.abs(end - 0.02) > 3.0 * span) & (end < 0.04 - 3.0 * span) & (end > span)
    np.testing.assert_allclose(reached[far], bend.at(end)[far], rtol=0, atol=1e-12)

    def missed(of):
        late = delay(taps, H) - H * np.arange(len(taps))
        return lambda time: of(time) - sum(tap * of(time + t) for tap, t in zip(taps, late))

    twice = missed(missed(bend.at))
    left = (twice if kind == "zero_vibration" else missed(twice))(end)
    near = ~far & (end < 0.03)
    np.testing.assert_allclose(bend.at(end)[near], (reached + left)[near], rtol=0, atol=1e-12)
    for course in (twice, missed(bend.at)):
        assert np.max(np.abs(left[near])) <= np.max(np.abs(course(end)[near]))


@pytest.mark.parametrize("kind", ["zero_vibration", "robust"])
def test_nothing_is_left_at_the_nominal_mode(kind):
    taps = shaper(ShapingParameters(kind=kind), DENOMINATOR, H)
    assert vibration_after_a_step(taps) < 1e-10


def test_robust_grows_with_the_square_of_the_deviation():
    """Convolution squares the residual of zero vibration, Singer and Seering 1990."""
    frequency = 1.05 / (2.0 * np.pi * np.sqrt(A2))
    one, two = (
        residual_vibration(
            shaper(ShapingParameters(kind=kind), DENOMINATOR, H), frequency, 0.017, H
        )
        for kind in ("zero_vibration", "robust")
    )
    assert two == pytest.approx(one**2, rel=1e-9)


@pytest.mark.parametrize("largest_tap", [0.08, 0.108, 1.0])
def test_least_time_keeps_its_bound_over_the_box_and_is_shorter_than_2_ms(largest_tap):
    parameters = ShapingParameters(largest_tap=largest_tap)
    taps = shaper(parameters, DENOMINATOR, H)
    assert max(taps) <= largest_tap + 1e-9
    assert len(taps) <= 20
    frequency = np.linspace(0.9, 1.1, 301)[:, None] / (2.0 * np.pi * np.sqrt(A2))
    ratio = np.linspace(0.5, 1.5, 7) * 0.5 * A1 / np.sqrt(A2)
    assert np.max(residual_vibration(taps, frequency, ratio, H)) <= 0.05


@pytest.mark.parametrize(
    "hertz, sample_time, count", [(1000.0, H, 12), (200.0, H, 47), (100.0, H, 91)]
)
def test_no_count_below_the_fewest_suffices(hertz, sample_time, count):
    """The counts that linear programs at 2, 3, 4, ... taps find, one after the other."""
    omega = 2.0 * np.pi * hertz
    mode = (1.0 / omega**2, 2.0 * 0.02 / omega, 1.0)
    assert len(shaper(ShapingParameters(residual=0.05), mode, sample_time)) == count


@pytest.mark.parametrize("hertz", [50.0, 20.0])
def test_a_slow_finger_is_shaped_within_seconds_of_a_processor(hertz):
    """At 10 kHz; one after the other, the linear programs took 46 s for 50 Hz, and 20 Hz was refused."""
    omega = 2.0 * np.pi * hertz
    begin = time.process_time()
    taps = shaper(ShapingParameters(), (1.0 / omega**2, 2.0 * 0.02 / omega, 1.0), H)
    assert time.process_time() - begin < 20.0
    frequency = np.linspace(0.9, 1.1, 301)[:, None] * hertz
    worst = residual_vibration(taps, frequency, np.linspace(0.01, 0.03, 7), H)
    assert np.max(worst) <= 0.05


def test_a_ramp_comes_late_by_the_delay():
    taps = shaper(ShapingParameters(), DENOMINATOR, H)
    past = [0.0] * longest(taps, 1.0)
    ramp = [shape(taps, past, k * H, 1.0) for k in range(50)]
    assert ramp[-1] == pytest.approx(49 * H - delay(taps, H), abs=1e-15)


def test_what_cannot_be_shaped_is_refused(monkeypatch):
    with pytest.raises(ParameterError, match="half the sampling rate"):
        shaper(ShapingParameters(), DENOMINATOR, 1e-3)
    monkeypatch.setattr(shaping, "LONGEST", 10)
    with pytest.raises(ParameterError, match="'residual' is 0.04: no shaper up to 10 samples"):
        shaper(ShapingParameters(residual=0.04), DENOMINATOR, H)


@pytest.mark.parametrize("ratio", [0.8, 0.93, 1.0, 1.07, 1.2])
def test_taps_in_the_time_of_another_mode_leave_as_little_of_it(ratio):
    """The bound of the box, 5 %; and the delay that whoever plans is told."""
    taps = shaper(ShapingParameters(), DENOMINATOR, H)
    impulse = [0.0] * longest(taps, ratio)
    seen = [shape(taps, impulse, float(k == 0), ratio) for k in range(len(impulse) + 1)]
    assert sum(seen) == pytest.approx(1.0, abs=1e-12)
    assert min(seen) >= 0.0 and seen[-1] == 0.0
    frequency = ratio / (2.0 * np.pi * np.sqrt(A2))
    assert residual_vibration(seen, frequency, 0.5 * A1 / np.sqrt(A2), H) < 0.05
    assert H * np.dot(seen, np.arange(len(seen))) == pytest.approx(delay(taps, H, ratio), rel=1e-9)
