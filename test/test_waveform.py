# SPDX-License-Identifier: Apache-2.0
"""Waveforms against their equations, and properties that hold for all of them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import chirp, sawtooth, square

from piezo_control.nodes.profile_input import waveform_message
from piezo_control.waveform import SHAPES, Waveform
from piezo_gripper_msgs.msg import Waveform as Message

TIME = np.linspace(0.0, 2.0, 1999)  # s; no instant on an edge of the steps below


def test_shapes_are_those_of_scipy():
    tau = 2.0 * np.pi * 3.0 * TIME
    shapes = {
        "sine": np.sin(tau),
        "step": 0.5 + 0.5 * square(tau),
        "triangle": sawtooth(tau + np.pi / 2.0, width=0.5),
    }
    for shape, expected in shapes.items():
        wave = Waveform(shape, amplitude=4.0, frequency=3.0, offset=-1.0)
        np.testing.assert_allclose(wave.at(TIME), -1.0 + 4.0 * expected, atol=1e-9)


def test_sweep_is_a_logarithmic_chirp_until_its_last_whole_cycle():
    wave = Waveform("sweep", amplitude=2.0, frequency=1.0, end_frequency=20.0, duration=2.0)
    expected = 2.0 * chirp(TIME, f0=1.0, t1=2.0, f1=20.0, method="logarithmic", phi=-90.0)
    runs = wave._phase(TIME) < 12.0  # 2 s (20 - 1) / ln 20 = 12.68 cycles
    assert wave.cycles == 12.0
    np.testing.assert_allclose(wave.at(TIME)[runs], expected[runs], atol=1e-9)
    assert not wave.at(TIME)[~runs].any()


def test_decaying_sine_falls_linearly_after_its_first_cycle():
    wave = Waveform("decaying_sine", amplitude=40.0, frequency=2.0, duration=2.5)
    quarters = wave.at(np.arange(5) / 2.0 + 0.125)  # s, where the sine is 1
    np.testing.assert_allclose(quarters, [40.0, 37.5, 27.5, 17.5, 7.5], rtol=1e-12)


QUICK = settings(max_examples=30)
START = st.just(0.0)


def waveforms(start):
    return st.builds(
        Waveform,
        shape=st.sampled_from(SHAPES),
        amplitude=st.floats(-1e-5, 1e-5),
        frequency=st.floats(2.0, 10.0),
        offset=st.floats(-1e-5, 1e-5),
        end_frequency=st.floats(20.0, 200.0),
        duration=st.floats(1.0, 5.0),
        start=start,
    )


@given(waveforms(START), st.lists(st.floats(-10.0, 10.0), min_size=1, max_size=20))
@QUICK
def test_values_stay_within_the_largest_and_outside_its_time_at_the_offset(wave, times):
    values = wave.at(times)
    assert np.all(np.abs(values) <= wave.largest * (1.0 + 1e-12))
    outside = np.array(times) < 0.0
    outside |= np.array(times) >= wave.duration
    assert np.all(values[outside] == wave.offset)


@given(waveforms(START), st.floats(-100.0, 100.0), st.lists(st.floats(0.0, 5.0), max_size=20))
@QUICK
def test_start_moves_the_whole_waveform(wave, start, times):
    later = Waveform(**{**vars(wave), "start": start})
    if wave.shape != "step":  # which may jump within the rounding of the sum
        at = np.array(times)
        steepest = 2.0 * math.pi * 200.0 * 1e-5 * 4.0
        np.testing.assert_allclose(later.at(at + start), wave.at(at), atol=steepest * 1e-12)


@given(waveforms(START))
@QUICK
def test_all_but_the_step_begin_and_end_without_a_jump(wave):
    if wave.shape != "step":
        fine = np.linspace(-0.01, wave.duration + 0.01, 20_001)
        steepest = 2.0 * math.pi * wave.highest_frequency * abs(wave.amplitude)
        assert (
            np.max(np.abs(np.diff(wave.at(fine)))) <= 1.01 * steepest * (fine[1] - fine[0]) + 1e-18
        )


@given(waveforms(st.floats(0.0, 1e3)))
@QUICK
def test_message_says_the_waveform(wave):
    assert Waveform.of(waveform_message(wave)) == wave
    assert getattr(Message, wave.shape.upper()) == SHAPES.index(wave.shape)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": "saw"}, "shape is 'saw', must be one of step, sine"),
        ({"amplitude": math.nan}, "amplitude is nan, must be finite"),
        ({"start": math.inf}, "start is inf, must be finite"),
        ({"frequency": 0.0}, r"frequency is 0, must be in \(0, 100000\] Hz"),
        ({"duration": -1.0}, r"duration is -1, must be in \[0, 1e\+06\] s"),
        ({"shape": "sweep", "duration": 9.0}, "end_frequency is 0, must be in"),
        ({"shape": "sweep", "end_frequency": 2.0, "duration": 9.0}, "that is a sine"),
        ({"shape": "sweep", "end_frequency": 5.0}, "must have room for 1 cycles of a sweep"),
        ({"shape": "decaying_sine", "duration": 0.9}, "must have room for 2 cycles"),
    ],
)  # fmt: skip
def test_impossible_waveforms_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Waveform(**{"shape": "sine", "amplitude": 1.0, "frequency": 2.0, **change})
