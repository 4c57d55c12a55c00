# SPDX-License-Identifier: Apache-2.0
"""The operator against the play's definition, and the inverse against the identity."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piezo_control.hysteresis import (
    Hysteresis,
    HysteresisParameters,
    coefficients,
    deflection_history,
    invert,
    play_history,
    reachable_range,
)
from piezo_control.parameters import ParameterError, build

LIMIT = 40.0  # V


def increasing(gaps):
    return tuple(np.cumsum(gaps).tolist())


@st.composite
def dead_zones(draw):
    """Thresholds (m) and weights whose slopes, 1 in the middle, stay between 0.2 and 3."""
    count = draw(st.integers(0, 3))
    gaps = draw(st.lists(st.floats(1e-7, 8e-6), min_size=count, max_size=count))
    slopes = draw(st.lists(st.floats(0.2, 3.0), min_size=count, max_size=count))
    return increasing(gaps), tuple(np.diff([1.0, *slopes]).tolist())


no_dead_zones, no_rate = st.just(((), ())), st.just(0.0)
SAMPLE_TIME = 0.1  # s


@st.composite
def hysteresis_parameters(draw, dead_zones=no_dead_zones, rate=no_rate):
    """Any order; slopes W_i from 0.05 to 1 um/V in any order, so that single weights are negative.

    `rate` is a fraction of the rate coefficient at which the inverse would become unstable.
    """
    count = draw(st.integers(0, 15))
    gaps = draw(st.lists(st.floats(0.01, 5.0), min_size=count, max_size=count))
    slopes = draw(st.lists(st.floats(0.05e-6, 1e-6), min_size=count + 1, max_size=count + 1))
    upper, lower = draw(dead_zones), draw(dead_zones)
    feedback = max([abs(1.0 - slopes[0] / slope) for slope in slopes])
    largest = SAMPLE_TIME / max(feedback, 0.1)
    return HysteresisParameters(
        (0.0, *increasing(gaps)),
        (slopes[0], *np.diff(slopes).tolist()),
        *upper,
        *lower,
        draw(rate) * largest,
    )


histories = st.lists(st.floats(-LIMIT, LIMIT), min_size=1, max_size=60)


@given(hysteresis_parameters(), histories)
def test_operator_is_the_weighted_sum_of_plays(parameters, history):
    plays = np.zeros(len(parameters.thresholds))
    thresholds = np.array(parameters.thresholds)
    expected = []
    for voltage in history:  # the definition, literally
        plays = np.minimum(voltage + thresholds, np.maximum(voltage - thresholds, plays))
        expected.append(np.dot(parameters.weights, plays))
    np.testing.assert_allclose(Hysteresis(parameters)(history), expected, rtol=0, atol=1e-18)
    np.testing.assert_array_equal(play_history(thresholds, history)[-1], plays)


@given(
    hysteresis_parameters(dead_zones(), st.floats(0.0, 0.9)),
    histories,
    histories,
)
@settings(max_examples=300)
def test_operator_after_inverse_is_the_identity(parameters, past, history):
    """Modified, rate-dependent, single negative weights, states of a random past: to 1e-12."""
    actuator = Hysteresis(parameters, sample_time=SAMPLE_TIME)
    actuator(past)
    before = copy.deepcopy(actuator.state)
    deflections = actuator(history)
    actuator.state = before
    inverse = actuator.inverse()
    span = np.ptp(reachable_range(actuator.coefficients, -LIMIT, LIMIT)) + np.ptp(deflections)
    voltages = inverse(deflections)
    np.testing.assert_allclose(voltages, history, rtol=0, atol=1e-12 * 2 * LIMIT)
    np.testing.assert_allclose(actuator(voltages), deflections, rtol=0, atol=1e-12 * span)
    np.testing.assert_allclose(
        inverse.actuator_plays(), actuator.state.plays, rtol=0, atol=1e-12 * 2 * LIMIT
    )


@given(hysteresis_parameters(dead_zones(), st.floats(0.0, 0.9)), histories, histories)
def test_inverse_follows_voltages_of_others(parameters, applied, history):
    """After voltages that were not the inverse's own, it is exact at the next sample."""
    actuator = Hysteresis(parameters, sample_time=SAMPLE_TIME)
    inverse = actuator.inverse()
    for voltage in applied:
        inverse.follow(voltage)
    actuator(applied)
    deflections = actuator(history)
    np.testing.assert_allclose(inverse(deflections), history, rtol=0, atol=1e-12 * 2 * LIMIT)


def test_inverse_started_from_zero_after_a_history_is_wrong_by_volts():
    actuator = Hysteresis(HysteresisParameters())
    fresh = actuator.inverse()
    actuator([40.0, 0.0])
    remanent = actuator.step(0.0)
    assert abs(fresh.step(remanent)) > 5.0
    assert abs(actuator.inverse().step(remanent)) < 1e-12


@given(hysteresis_parameters(), st.floats(0.0, 1.0), st.floats(0.0, LIMIT))
def test_a_virgin_share_bends_the_first_rise_and_the_first_fall_alike(parameters, share, voltage):
    """By the joins: a part 1 - v at r, and v/2 each at 0 and at 2 r."""
    r, w = np.array(parameters.thresholds), np.array(parameters.weights)
    at_r, at_2r = np.maximum(voltage - r, 0.0), np.maximum(voltage - 2.0 * r, 0.0)
    expected = w @ ((1.0 - share) * at_r + 0.5 * share * (voltage + at_2r))
    virgin = replace(parameters, virgin_share=share)
    for side in (1.0, -1.0):
        there = deflection_history(virgin, [side * voltage])[0]
        assert there == pytest.approx(side * expected, abs=1e-18)


@pytest.mark.parametrize("share", [-0.01, 1.01])
def test_a_virgin_share_that_is_no_part_is_refused(share):
    message = rf"finger.yaml: 'virgin_share' is {share}, must be in \[0, 1\]"
    with pytest.raises(ParameterError, match=message):
        build(HysteresisParameters, {"virgin_share": share}, "finger.yaml")


@given(hysteresis_parameters(), st.floats(0.0, 1.0), histories)
def test_of_a_virgin_share_nothing_is_left_once_the_voltage_has_been_to_both_ends(
    parameters, share, history
):
    largest = max(parameters.thresholds[-1], LIMIT)
    history = [2.0 * largest, -2.0 * largest, *history]
    virgin = deflection_history(replace(parameters, virgin_share=share), history)
    np.testing.assert_allclose(
        virgin[1:], deflection_history(parameters, history)[1:], rtol=0, atol=1e-18
    )


def test_initial_states_can_be_given():
    plays = [1.0, 3.0, 2.0, -0.5]
    parameters = HysteresisParameters((0.0, 2.0, 5.0, 9.0), (4e-7, 1e-7, -5e-8, 2e-7))
    actuator = Hysteresis(parameters, plays=plays)
    inverse = actuator.inverse()
    history = [3.0, -7.0, 12.0, 1.5]
    first = actuator(history)
    np.testing.assert_allclose(inverse(first), history, rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("plays", "message"),
    [([0.0, 3.1, 3.0], r"plays\[1\] is 3.1"), ([0.0, -2.0, 4.5], r"plays\[2\] is 4.5"), ([0.0], "1 plays")],
)  # fmt: skip
def test_states_no_history_leads_to_are_refused(plays, message):
    with pytest.raises(ParameterError, match=message):
        Hysteresis(HysteresisParameters((0.0, 3.0, 6.0), (1e-7, 1e-7, 1e-7)), plays=plays)


def test_analytic_inverse_of_two_plays_by_hand():
    """w = (2, 1) m/V, r = (0, 3) V: slopes 2 and 3, the loop of the inverse turns at 2 * 3 m."""
    inverse = invert(coefficients(HysteresisParameters((0.0, 3.0), (2.0, 1.0)), 1.0))
    assert inverse.thresholds == [0.0, 6.0]
    assert inverse.weights == pytest.approx([1 / 2, 1 / 3 - 1 / 2], rel=1e-15)
    back = invert(inverse)
    assert back.thresholds == pytest.approx([0.0, 3.0], rel=1e-15)
    assert back.weights == pytest.approx([2.0, 1.0], rel=1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": (1e-7, -4e-8, -6e-8)}, r"'weights\[2\]' is -6e-08: the slope 0 up to and with index 2"),
        ({"weights": (-1e-7, 4e-7, 1e-7)}, r"'weights\[0\]'"),
        ({"weights": (1e-7, 4e-8)}, "'weights' has 2 values, must have as many as 'thresholds': 3"),
        ({"thresholds": (0.0, 2.0, 2.0)}, r"'thresholds\[2\]' is 2.0, must be greater"),
        ({"thresholds": (1.0, 2.0, 3.0)}, "must start with 0.0 V"),
        ({"thresholds": (0.0, math.nan, 3.0)}, r"'thresholds\[1\]' is nan"),
        ({"weights": (1e-7, math.nan, 1e-7)}, r"'weights\[1\]' is nan"),
        ({"upper_thresholds": (1e-6, 2e-6), "upper_weights": (0.5, -1.5)}, r"'upper_weights\[1\]'"),
        ({"lower_thresholds": (2e-6, 1e-6), "lower_weights": (0.1, 0.1)}, r"'lower_thresholds\[1\]'"),
    ],
)  # fmt: skip
def test_parameters_without_inverse_are_refused_by_index(change, message):
    valid = {"thresholds": (0.0, 3.0, 6.0), "weights": (1e-7, 1e-7, 1e-7)}
    with pytest.raises(ParameterError, match=message):
        HysteresisParameters(**{**valid, **change})


def test_default_loop_is_that_of_the_paper():
    """Fig. 5: about +-22 um at +-40 V; the width of 15 to 20 % is the design's."""
    actuator = Hysteresis(HysteresisParameters())
    voltage = 40.0 * np.sin(2 * np.pi * np.linspace(0.0, 2.0, 801))
    deflection = actuator(voltage)[401:]
    assert deflection.max() == pytest.approx(22e-6, rel=1e-9)
    assert deflection.min() == pytest.approx(-22e-6, rel=1e-9)
    falling, rising = deflection[199], deflection[399]  # the two passages through 0 V
    assert 0.15 <= (falling - rising) / 44e-6 <= 0.20


def test_reachable_range_is_reached_and_not_passed():
    parameters = HysteresisParameters(
        upper_thresholds=(5e-6,), upper_weights=(0.2,), lower_thresholds=(8e-6,), lower_weights=(-0.1,)
    )  # fmt: skip
    low, high = reachable_range(coefficients(parameters, 1.0), -LIMIT, LIMIT)
    assert high == pytest.approx(22e-6 + 0.2 * 17e-6, rel=1e-12)
    assert low == pytest.approx(-22e-6 + 0.1 * 14e-6, rel=1e-12)
    actuator = Hysteresis(parameters)
    assert actuator.step(LIMIT) == pytest.approx(high, rel=1e-12)
    assert actuator.step(-LIMIT) == pytest.approx(low, rel=1e-12)


@given(st.floats(0.0, 30.0), st.floats(31.0, 150.0))
def test_an_actuator_driven_to_one_side_reaches_the_ends_of_its_loop(low, high):
    """Where it was homed it does not come back to: the lower end is that of the loop."""
    actuator = Hysteresis(HysteresisParameters())
    ends = reachable_range(coefficients(HysteresisParameters(), 1.0), low, high)
    passed = [actuator.step(voltage) for voltage in (low, high, low, high)]
    assert passed[2:] == pytest.approx(ends, rel=1e-12)
    assert passed[0] <= passed[2] + 1e-18


def test_rate_dependence_widens_the_loop_by_the_threshold():
    """One play at a constant rate lags by r + b |du/dt| when moving up."""
    parameters = HysteresisParameters((0.0, 1.0), (1e-7, 1e-7), rate_coefficient=0.02)
    ramp = 30.0 * np.arange(0.0, 1.0, 0.01)  # 30 V/s
    deflection = Hysteresis(parameters, sample_time=0.01)(ramp)
    assert deflection[-1] == pytest.approx(1e-7 * (2 * ramp[-1] - (1.0 + 0.02 * 30.0)), rel=1e-12)


def test_unstable_inverse_of_a_rate_dependent_operator_is_refused():
    """Slopes 1 and 2: feedback b/T (1 - 1/2), so the bound is b = 2 T."""
    parameters = {"thresholds": (0.0, 1.0), "weights": (1e-7, 1e-7)}
    Hysteresis(HysteresisParameters(**parameters, rate_coefficient=0.199), 0.1).inverse()
    actuator = Hysteresis(HysteresisParameters(**parameters, rate_coefficient=0.2), 0.1)
    with pytest.raises(ParameterError, match="is 2 sample times, must be below 2: .* unstable"):
        actuator.inverse()


def test_errors_fade_in_the_inverse_of_a_rate_dependent_operator():
    parameters = HysteresisParameters((0.0, 1.0), (1e-7, 1e-7), rate_coefficient=0.18)
    actuator = Hysteresis(parameters, 0.1)
    deflection = 1e-7 * np.linspace(0.0, 40.0, 400)
    undisturbed = actuator.inverse()(deflection)
    deflection[10] += 1e-9
    assert abs(actuator.inverse()(deflection) - undisturbed)[-1] < 1e-9


@given(hysteresis_parameters(dead_zones(), st.floats(0.0, 0.9)), histories)
def test_history_at_once_equals_step_by_step(parameters, history):
    single = Hysteresis(parameters, SAMPLE_TIME)(history)
    at_once = deflection_history(parameters, np.asarray(history), SAMPLE_TIME)
    np.testing.assert_allclose(at_once, single, rtol=1e-12, atol=1e-18)


def test_play_history_with_changing_thresholds():
    """A growing threshold lets the play rest; a shrinking one pulls it along."""
    thresholds = np.array([[1.0], [3.0], [0.5]])
    history = play_history(thresholds, [2.0, 4.0, 4.0], plays=[0.0])
    np.testing.assert_array_equal(history[:, 0], [1.0, 1.0, 3.5])
