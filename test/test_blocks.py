# SPDX-License-Identifier: Apache-2.0
"""Samples in blocks: a bag of the servo reads as one of single samples; the reference is what was followed."""

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from piezo_control.recording.recording import BLOCK_TYPE, PROFILE_TYPE, SAMPLE_TYPE, read
from piezo_control.recording.writer import BagWriter
from piezo_gripper_msgs.msg import Profile, Sample, SampleBlock

H = 1e-4
WALL = 1_700_000_000 * 10**9  # ns


@pytest.fixture
def bag(tmp_path):
    return BagWriter(tmp_path / "bag")


def make(kind, nanoseconds, **fields):
    """Return a serialized message with this stamp."""
    message = kind(**fields)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
    return serialize_message(message)


def test_blocks_are_read_as_samples_and_a_missed_number_is_left_out(bag):
    k = np.arange(1000)
    signals = {
        "reference": 1e-6 * k, "deflection": 2e-6 * k, "command": 3e-6 * k, "voltage": 0.01 * k,
    }  # fmt: skip
    signals["deflection"][500] = np.nan
    connection = bag.add("/left/samples", BLOCK_TYPE, False)
    single = bag.add("/left/deflection", SAMPLE_TYPE, False)
    for first, last in ((0, 300), (301, 400), (400, 1000)):  # number 300 was missed
        stamp = WALL + first * 100_000
        block = {name: signal[first:last] for name, signal in signals.items()}
        block["late"] = np.zeros(last - first)
        bag.write(connection, stamp, make(SampleBlock, stamp, number=first, period=H, **block))
        bag.write(
            single, stamp,
            make(Sample, stamp, number=first, value=0.0),
        )  # fmt: skip
    bag.close()
    got = read(bag.path)
    rows = np.delete(k, 300)
    np.testing.assert_array_equal(got.number, rows)
    for name, signal in signals.items():
        np.testing.assert_array_equal(getattr(got, name), signal[rows])
    np.testing.assert_allclose(got.time, rows * H, rtol=0, atol=1e-6)
    assert got.sample_time == H


@pytest.mark.parametrize("receives", [False, True], ids=["own stamps", "times of arrival"])
def test_the_reference_is_that_of_each_moment(bag, receives):
    """A profile, then a set-point without a stamp, then another profile: each from when it came."""
    offset = WALL if receives else 0  # a recorder that stamps with its own clock
    samples = bag.add("/deflection", SAMPLE_TYPE, False)
    profiles = bag.add("/reference_profile", PROFILE_TYPE, True)
    points = bag.add("/reference", SAMPLE_TYPE, False)

    def profile(at, value):
        data = make(Profile, 0, time=[0.0], value=[value])
        bag.write(profiles, offset + at, data)

    profile(0, 5e-6)
    for k in range(3000):
        if k == 1000:
            data = make(Sample, 0, number=0, value=10e-6)
            bag.write(points, offset + k * 100_000, data)
        if k == 2000:
            profile(k * 100_000, -5e-6)
        data = make(Sample, k * 100_000, number=k, value=0.0)
        bag.write(samples, offset + k * 100_000, data)
    bag.close()
    expected = np.repeat([5e-6, 10e-6, -5e-6], 1000)
    np.testing.assert_array_equal(read(bag.path).reference, expected)
