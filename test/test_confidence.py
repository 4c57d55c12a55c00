# SPDX-License-Identifier: Apache-2.0
"""95 % intervals: as wide as what is found spreads over repeated measurements, also where noise is correlated."""

import numpy as np
import pytest
from scipy.signal import lfilter

from piezo_control.hysteresis import HysteresisParameters, deflection_history
from piezo_control.identification.confidence import intervals, lines, memory
from piezo_control.identification.dynamics import DynamicsModel, identify_dynamics
from piezo_control.identification.hysteresis import identify_hysteresis
from piezo_control.identification.measurement import Measurement

TIME = np.arange(4000) * 5e-3
VOLTAGE = 40.0 * np.sin(2.0 * np.pi * TIME)


def correlated(random, kept, deviation, size=TIME.size):
    """Noise of a standard deviation, of which each sample keeps a part of the one before."""
    white = random.normal(0.0, deviation * np.sqrt(1.0 - kept**2), size + 500)
    return lfilter([1.0], [1.0, -kept], white)[500:]


@pytest.mark.parametrize("kept", [0.0, 0.9])
def test_the_interval_holds_the_truth_in_19_of_20_measurements(kept):
    """300 of them, so that 0.95 is seen to ± 0.025; for a memory of 19 samples, white intervals hold a mean in 0.35.

    Also of what only the beginning tells: there, blocks alone would hold the truth in 0.8 and 0.6.
    """
    matrix = np.column_stack(
        (np.sin(2.0 * np.pi * TIME), np.exp(-TIME / 0.3), np.ones_like(TIME), TIME)
    )
    truth = np.array([1.0, 0.5, 2.0, 0.1])
    random = np.random.default_rng(0)
    held = np.zeros(4)
    for _ in range(300):
        measured = matrix @ truth + correlated(random, kept, 0.1)
        fitted = np.linalg.lstsq(matrix, measured, rcond=None)[0]
        width = intervals(lambda x: {"x": tuple(x)}, fitted, matrix, measured - matrix @ fitted)
        held += np.abs(fitted - truth) <= width["x"]
    assert np.all(held / 300 >= 0.91) and np.all(held / 300 <= 0.99)


def test_an_error_that_is_larger_in_places_counts_there():
    """Noise in the first tenth only: the amount of what is there spreads as in a measurement as short as that."""
    matrix = np.column_stack((np.exp(-TIME / 0.3), np.ones_like(TIME)))
    there = TIME < 2.0
    random = np.random.default_rng(1)
    held = 0
    for _ in range(300):
        noise = random.normal(size=TIME.size) * there
        fitted = np.linalg.lstsq(matrix, noise, rcond=None)[0]
        width = intervals(lambda x: {"x": x[0]}, fitted, matrix, noise - matrix @ fitted)
        held += abs(fitted[0]) <= width["x"]
    assert 0.86 <= held / 300 <= 0.99


def test_what_another_choice_leads_away_is_added():
    random = np.random.default_rng(2)
    matrix, fitted = np.ones((400, 1)), np.array([1.0])
    given = (lambda x: {"x": x[0]}, fitted, matrix, random.normal(0.0, 0.1, 400))
    alone = intervals(*given)["x"]
    assert intervals(*given, others=[np.array([1.5]), np.array([0.7])])["x"] == alone + 0.5


def test_the_memory_of_a_residual():
    """White noise: one sample; with 0.9 of the one before: (1 + 0.9) / (1 - 0.9) = 19."""
    random = np.random.default_rng(3)
    assert memory(random.normal(size=200_000)) == pytest.approx(1.0, abs=0.05)
    assert memory(correlated(random, 0.9, 1.0, 200_000)) == pytest.approx(19.0, rel=0.1)
    assert memory(np.zeros(100)) == 1.0


def spread_over_width(fit, names, repetitions):
    """Return, by name, 1.96 standard deviations of what is found over the median half width."""
    models = [fit(np.random.default_rng(seed)) for seed in range(repetitions)]
    ratios = {}
    for name, value in names.items():
        found = np.array([value(model) for model in models])
        widths = np.array([model.confidence[name] for model in models])
        ratios[name] = 1.96 * found.std(axis=0, ddof=1) / np.median(widths, axis=0)
    return ratios


def test_weights_spread_as_far_as_the_interval_says():
    """40 repetitions give a standard deviation to 11 %; three of these."""
    truth = HysteresisParameters((0.0, 5.0, 12.0, 20.0), (4e-7, 1.2e-7, 8e-8, 5e-8))
    exact = deflection_history(truth, VOLTAGE)

    def fit(random):
        noisy = exact + correlated(random, 0.8, 0.1e-6)
        measurement = Measurement("sim", TIME, VOLTAGE, noisy, None, None, np.arange(TIME.size))
        return identify_hysteresis(measurement, truth.thresholds, lag=0.0)

    ratios = spread_over_width(
        fit, {"hysteresis.weights": lambda m: m.parameters.weights}, repetitions=40
    )
    np.testing.assert_allclose(ratios["hysteresis.weights"], 1.0, atol=0.35)


def test_frequency_and_damping_spread_as_far_as_the_interval_says():
    """12 repetitions give a standard deviation to 21 %; two and a half of these."""
    truth = DynamicsModel(2.0 * np.pi * 300.0, 0.02, 5e-7, 0.0, 0.0, 0)
    time = np.arange(1000) * 2e-4
    voltage = np.where(time < 0.01, 0.0, 20.0)
    exact = truth.deflection(time, voltage)

    def fit(random):
        noisy = exact + correlated(random, 0.5, 0.2e-6, time.size)
        measurement = Measurement("sim", time, voltage, noisy, None, None, np.arange(time.size))
        return identify_dynamics(measurement, voltage)

    names = {
        "natural_frequency_hz": lambda m: m.natural_frequency / (2.0 * np.pi),
        "damping_ratio": lambda m: m.damping_ratio,
        "gain": lambda m: m.gain,
    }
    for ratio in spread_over_width(fit, names, repetitions=12).values():
        assert ratio == pytest.approx(1.0, abs=0.55)


def test_lines_for_people_leave_out_what_has_no_interval():
    found = {"gain": 5.5e-7, "times": (2.0, 15.0), "lag": 0.0}
    widths = {"gain": 1.2e-9, "times": (0.5, 1.0), "lag": 0.0}
    assert lines(found, widths) == ["gain: 5.5e-07 ± 1.2e-09", "times: 2 ± 0.5, 15 ± 1"]
