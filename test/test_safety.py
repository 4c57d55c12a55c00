# SPDX-License-Identifier: Apache-2.0
"""The safety law by its properties: limits in time, hold, ramp, a fault that stays."""

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from piezo_control.parameters import ParameterError
from piezo_control.safety import (
    FAULT,
    HOLDING,
    NORMAL,
    RAMPING,
    Guard,
    RateWatch,
    VoltageParameters,
    limited,
    limits,
    toward,
)

volts = st.floats(-200.0, 200.0)
STACK = VoltageParameters(voltage_low=0.0, voltage_high=150.0, slew_limit=1e4)


@given(volts, st.floats(0.0, 200.0), st.floats(1e-6, 50.0), st.floats(0.0, 1.0), st.floats())
def test_limited_is_the_nearest_voltage_that_is_allowed(low, span, change, place, wanted):
    high = low + span
    last = low + place * span
    voltage = limited(low, high, change, last, wanted)
    assert low <= voltage <= high
    assert abs(voltage - last) <= change * (1 + 1e-12) + 1e-12
    if low <= wanted <= high and abs(wanted - last) <= change * (1 - 1e-12):
        assert voltage == wanted


@given(volts, st.floats(0.0, 200.0), st.floats(1e-6, 50.0), volts, volts)
def test_a_voltage_outside_its_limits_is_led_back_and_does_not_leap(
    low, span, change, last, wanted
):
    high = low + span
    voltage = limited(low, high, change, last, wanted)
    assert abs(voltage - last) <= change * (1 + 1e-12) + 1e-12
    outside = [max(low - v, v - high, 0.0) for v in (last, voltage)]
    assert outside[1] == 0.0 or outside[1] < outside[0]


@given(volts, st.floats(0.0, 100.0), volts)
def test_toward_rest_never_passes_it(rest, step, voltage):
    nearer = toward(rest, step, voltage)
    assert abs(nearer - rest) <= abs(voltage - rest)
    assert abs(nearer - voltage) <= step + 1e-12
    assert (nearer - rest) * (voltage - rest) >= 0.0


def test_rest_is_where_it_is_said_or_nearest_to_0_v_and_the_ramp_no_steeper_than_the_slew():
    assert limits(STACK, 1e7)[2:] == (1e4, 1e4, 0.0)
    assert limits(VoltageParameters(voltage_low=20.0, voltage_high=120.0), 1e3).rest == 20.0
    assert limits(VoltageParameters(voltage_low=-120.0, voltage_high=-20.0), 1e3).rest == -20.0
    assert limits(replace(STACK, rest_voltage=75.0), 1e3).rest == 75.0
    outside = r"'rest_voltage' is -1.0 V, must be within .* \[0, 150\] V"
    with pytest.raises(ParameterError, match=outside):
        replace(STACK, rest_voltage=-1.0)
    with pytest.raises(ParameterError, match="'voltage_low' is 50.0 V, must be below"):
        VoltageParameters(voltage_low=50.0)


@given(
    st.lists(
        st.tuples(st.floats(1e-4, 0.3), st.sampled_from(["hear", "look", "trip"])), max_size=60
    ),
    st.floats(0.0, 150.0),
)
def test_whatever_happens_a_latched_fault_goes_to_rest_and_stays(events, voltage):
    guard, now, last = Guard(hold_time=0.1), 0.0, voltage
    within = limits(STACK, 1e3)
    latched = False
    for wait, event in events:
        now += wait
        if event == "hear":
            guard.hear(now)
        elif event == "trip":
            guard.trip("tripped", now)
        else:
            guard.look(now, 0.01, "command")
        assert guard.is_latched or not latched
        latched = guard.is_latched
        assert (guard.cause == "") == (guard.phase == NORMAL)
        following = guard.voltage(within, last, wait)
        assert within.low <= following <= within.high
        assert abs(following - last) <= 1e3 * wait * (1 + 1e-9)
        assert latched or following == last
        last = following
    if latched:
        assert guard.voltage(within, last, 150.0 / 1e3) == within.rest
        assert guard.phase == FAULT
        guard.hear(now)
        assert guard.phase == FAULT and guard.times >= 1
        guard.reset()
        assert guard.phase == NORMAL and guard.cause == "" and guard.times == 0


@pytest.mark.shows("an input is late", "it stays away for `hold_time`")
def test_a_late_input_holds_and_a_missing_one_ramps():
    guard = Guard(hold_time=0.1)
    guard.look(1e6, 0.01, "command")  # nothing is missed before the first one
    assert guard.phase == NORMAL
    guard.hear(0.0)
    guard.look(0.05, 0.01, "command")
    assert (guard.phase, guard.since) == (HOLDING, 0.05)
    guard.hear(0.06)
    assert (guard.phase, guard.cause) == (NORMAL, "")
    guard.look(0.17, 0.01, "command")
    assert (guard.phase, guard.cause, guard.since) == (RAMPING, "no command for 0.1 s", 0.17)
    guard.trip("another", 0.18)
    assert (guard.cause, guard.times) == ("no command for 0.1 s", 2)


def test_rate_is_the_mean_of_a_window():
    watch = RateWatch(1e-3)
    periods = [watch.see(1e-3 * k) for k in range(RateWatch.WINDOW + 1)]
    assert periods[:-1] == [0.0] * RateWatch.WINDOW
    assert periods[-1] == pytest.approx(1e-3, rel=1e-12) and watch.is_right(periods[-1])
    assert (
        not watch.is_right(1.3e-3) and not watch.is_right(0.7e-3) and not watch.is_right(math.nan)
    )
