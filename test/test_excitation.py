# SPDX-License-Identifier: Apache-2.0
"""The decaying sine: its shape, and that it homes a finger whatever its past."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from piezo_control.feedforward import Feedforward, FeedforwardParameters
from piezo_control.hysteresis import Hysteresis, HysteresisParameters
from piezo_control.identification.excitation import decaying_sine


def test_amplitudes_fall_linearly_to_zero():
    profile = decaying_sine(40.0, cycles=5, frequency_hz=2.0, points_per_cycle=400)
    assert profile.linear and profile.time[-1] == 2.5 and profile.value[-1] == 0.0
    quarters = profile.value[100::400]  # a quarter into each cycle, where the sine is 1
    np.testing.assert_allclose(quarters, [40.0, 37.5, 27.5, 17.5, 7.5], rtol=1e-12)


@given(st.lists(st.floats(-40.0, 40.0), max_size=30))
@settings(max_examples=30)
def test_sweep_homes_a_finger_whatever_its_past(past):
    """Full amplitude wipes the past out; what is left is half the last amplitude step."""
    actuator = Hysteresis(HysteresisParameters())
    law = Feedforward(FeedforwardParameters(slew_limit=1e6), 1e-3)  # knows nothing of the past
    actuator(past)
    for voltage in decaying_sine(40.0, cycles=20).value.tolist():
        deflection = actuator.step(voltage)
        law.follow(voltage)
    assert abs(deflection) < 0.1e-6
    for command in (5e-6, -12e-6, 20e-6):
        assert actuator.step(law.step(command)) == pytest.approx(command, rel=0, abs=1e-12 * 44e-6)


@pytest.mark.parametrize(("change", "message"), [({"cycles": 1}, "cycles is 1"), ({"frequency_hz": 0.0}, "frequency_hz is 0")])  # fmt: skip
def test_impossible_sweeps_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        decaying_sine(40.0, **change)
