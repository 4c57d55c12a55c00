# SPDX-License-Identifier: Apache-2.0
"""Sensor: resolution, noise, delay, drop-outs."""

import numpy as np
import pytest

from piezo_sim.plant.sensor import Sensor, read


def readings(deflections, resolution=0.0, noise=0.0, dropout_rate=0.0, delay=0, seed=1):
    line = [0.0] * (delay + 1)
    sensor = Sensor(resolution, noise, dropout_rate)
    random = np.random.default_rng(seed)
    out = []
    for deflection in deflections:
        read(line, sensor, deflection, random.standard_normal(), random.random())
        out.append(line[0])
    return np.array(out)


def test_readings_are_the_nearest_multiples_of_the_resolution():
    got = readings([14e-9, 16e-9, -14e-9, -16e-9, 1e-6], resolution=10e-9)
    assert got == pytest.approx([10e-9, 20e-9, -10e-9, -20e-9, 1e-6], abs=1e-18)


def test_without_imperfections_the_reading_is_the_deflection():
    deflections = [1.23456789e-6, -7e-13]
    assert readings(deflections).tolist() == deflections


@pytest.mark.parametrize("delay", [0, 1, 5])
def test_readings_come_out_late(delay):
    deflections = np.arange(1, 21) * 1e-6
    got = readings(deflections, delay=delay)
    assert got[:delay].tolist() == [0.0] * delay
    assert got[delay:].tolist() == deflections[: 20 - delay].tolist()


def test_noise_has_the_standard_deviation_asked_for():
    got = readings(np.zeros(20000), noise=5e-9)
    # The deviation of a standard deviation of n values is 1 / sqrt(2 n): here 0.5 %, times 4.
    assert np.std(got) == pytest.approx(5e-9, rel=0.02)
    assert np.mean(got) == pytest.approx(0.0, abs=4 * 5e-9 / np.sqrt(20000))


def test_a_dropout_repeats_the_reading_before():
    deflections = np.arange(1, 20001) * 1e-9
    got = readings(deflections, dropout_rate=0.3)
    lost = got != deflections
    assert np.mean(lost) == pytest.approx(0.3, abs=4 * np.sqrt(0.3 * 0.7 / 20000))
    before = np.concatenate([[0.0], got[:-1]])
    assert np.array_equal(got[lost], before[lost])
