# SPDX-License-Identifier: Apache-2.0
"""A temperature that is missing or frozen is named, is not used, and is believed again when it is back."""

import math

import pytest

from piezo_control.thermometer import Thermometer, ThermometerParameters


@pytest.mark.parametrize("heard", [[], [(0.0, 25.0), (1.0, 25.1)]])
def test_a_missing_temperature_is_named_and_believed_again(heard):
    thermometer = Thermometer(ThermometerParameters(timeout=2.0), 0.0)
    for now, degc in heard:
        thermometer.hear(degc, now)
    end = heard[-1][0] if heard else 0.0
    thermometer.read(end + 2.0)
    assert thermometer.wrong == ""
    assert math.isnan(thermometer.read(end + 2.01))
    assert thermometer.wrong == "temperature missing: none for 2 s"
    thermometer.hear(30.0, end + 3.0)
    assert thermometer.read(end + 3.0) == 30.0
    assert thermometer.wrong == ""


def test_a_frozen_temperature_is_named_only_where_that_is_asked_for():
    watching = Thermometer(ThermometerParameters(frozen_after=10.0), 0.0)
    trusting = Thermometer(ThermometerParameters(), 0.0)
    for now in range(100):
        for thermometer in (watching, trusting):
            thermometer.hear(25.0, float(now))
            expected = math.nan if thermometer is watching and now > 10 else 25.0
            assert thermometer.read(float(now)) == pytest.approx(expected, nan_ok=True)
    assert watching.wrong == "temperature frozen: 25 °C for 10 s"
    watching.hear(25.01, 100.0)
    assert watching.read(100.0) == 25.01
