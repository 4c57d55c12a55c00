# SPDX-License-Identifier: Apache-2.0
"""Creep against its closed forms: sums of exponentials, and the logarithm."""

import numpy as np
import pytest

from piezo_control.creep import CreepParameters, creep_step, discretize, logarithmic
from piezo_control.parameters import ParameterError


@pytest.mark.parametrize("sample_time", [1e-3, 0.1, 5.0])
def test_held_drive_gives_the_sum_of_exponentials(sample_time):
    times = np.array([2.0, 15.0, 110.0])
    shares = np.array([0.2, 0.3, 0.5])
    creep = discretize(1e-7, 1e-8, times, shares, sample_time)
    states = [0.0, 0.0, 0.0]
    for _ in range(round(10.0 / sample_time)):
        total = creep_step(creep, states, 25.0, 10.0)  # driven by (1e-7 + 10 * 1e-8) * 25 m
    expected = 5e-6 * np.sum(shares * (1.0 - np.exp(-10.0 / times)))
    assert total == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("onset, last", [(0.1, 1e4), (1e-3, 10.0), (1.0, 3.0)])
def test_logarithmic_creep_is_the_logarithm(onset, last):
    times, weights = logarithmic(onset, last)
    time = np.geomspace(onset / 10.0, last, 200)
    response = np.sum(weights * -np.expm1(-time[:, None] / times), axis=1)
    np.testing.assert_allclose(response, np.log1p(time / onset), atol=0.01)


def test_shares_that_do_not_fit_are_refused():
    with pytest.raises(ParameterError, match="'shares' has 2 values, 'times' 3"):
        CreepParameters(shares=(0.5, 0.5))
    with pytest.raises(ParameterError, match="'shares' sums to 0.9"):
        CreepParameters(shares=(0.2, 0.3, 0.4))
