# SPDX-License-Identifier: Apache-2.0
"""Amplifier: clip, slew rate, bandwidth, each against its definition."""

import math

import pytest

from piezo_sim.plant.amplifier import AmplifierParameters, AmplifierState, amplify, discretize


def respond(parameters, demands, sample_time=1e-4):
    state = AmplifierState([0.0], [0.0])
    amplifier = discretize(parameters, sample_time)
    return [amplify(state, amplifier, demand) for demand in demands], int(state.clipped[0])


def test_within_the_limits_the_ideal_amplifier_changes_nothing():
    demands = [1.0, -37.999, 2.0, 1.0 / 3.0, 39.5, 40.0, 10.0, -25.0, -40.0]
    assert respond(AmplifierParameters(), demands) == (demands, 0)


def test_beyond_the_limits_it_clips_and_counts():
    applied, clipped = respond(AmplifierParameters(voltage_low=-10.0), [50.0, 20.0, -11.0, 3.0])
    assert applied == [40.0, 20.0, -10.0, 3.0]
    assert clipped == 2


def test_slew_rate_limits_the_change_per_sample():
    applied, clipped = respond(AmplifierParameters(slew_limit=1e5), [25.0] * 4 + [-25.0] * 2)
    assert applied == pytest.approx([10.0, 20.0, 25.0, 25.0, 15.0, 5.0])
    assert clipped == 4


def test_bandwidth_is_a_first_order_lag():
    applied, _ = respond(AmplifierParameters(bandwidth_hz=1000.0, slew_limit=1e6), [10.0] * 10)
    assert applied[9] == pytest.approx(10.0 * (1.0 - math.exp(-2.0 * math.pi)), rel=1e-12)
