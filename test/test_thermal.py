# SPDX-License-Identifier: Apache-2.0
"""The body follows the thermocouple with a first-order lag, exact at any sample time."""

import math

import pytest

from piezo_control.thermal import Body, ThermalParameters, discretize, warm


def temperature_after(time_constant, sample_time, samples):
    thermal = discretize(ThermalParameters(time_constant=time_constant), 7e-7, sample_time)
    body = Body([22.0], [22.0])
    for _ in range(samples):
        warm(thermal, body, 32.0)
    return body.degc[0]


@pytest.mark.parametrize("samples", [1, 7, 3000])
def test_after_one_time_constant_1_minus_1_over_e_is_reached(samples):
    body = temperature_after(0.3, 0.3 / samples, samples)
    assert body == pytest.approx(32.0 - 10.0 / math.e, abs=1e-9)


def test_without_time_constant_it_follows_at_once():
    assert temperature_after(0.0, 1e-4, 1) == 32.0
