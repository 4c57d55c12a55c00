# SPDX-License-Identifier: Apache-2.0
"""D(s) stepped exactly, against the matrix exponential and the paper's figures."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm

from piezo_control.dynamics import DynamicsParameters, Motion, move, propagator
from piezo_control.parameters import ParameterError

INERTIA, DAMPING, _ = DynamicsParameters().denominator


@pytest.mark.parametrize("damping_ratio", [0.0, 0.017, 0.5, 1.0 - 1e-9, 1.0, 1.0 + 1e-9, 3.0, 1e3])
@pytest.mark.parametrize("time", [1e-6, 1e-4, 1e-2])
def test_propagator_is_the_matrix_exponential(damping_ratio, time):
    damping = 2.0 * damping_ratio * math.sqrt(INERTIA)
    a = np.array([[0.0, 1.0], [-1.0 / INERTIA, -damping / INERTIA]])
    # With a third state that stands still: the formula for 2 x 2 of the scipy of Jazzy, 1.11, overflows.
    exact = expm(block_diag(a * time, 0.0))[:2, :2]
    got = np.reshape(propagator(INERTIA, damping, 1.0, time), (2, 2))
    scale = np.array([[1.0, math.sqrt(INERTIA)], [1.0 / math.sqrt(INERTIA), 1.0]])
    np.testing.assert_allclose(got / scale, exact / scale, atol=1e-9)


@given(st.floats(1e-6, 1e-2), st.floats(1e-6, 1e-2), st.floats(0.0, 1e-3))
def test_two_steps_make_one(first, second, damping):
    one = np.reshape(propagator(INERTIA, damping, 1.0, first + second), (2, 2))
    two = np.reshape(propagator(INERTIA, damping, 1.0, second), (2, 2)) @ np.reshape(
        propagator(INERTIA, damping, 1.0, first), (2, 2)
    )
    scale = np.array([[1.0, math.sqrt(INERTIA)], [1.0 / math.sqrt(INERTIA), 1.0]])
    np.testing.assert_allclose(two / scale, one / scale, atol=1e-11)


def test_step_response_rings_at_667_hz_with_damping_0_017_and_ends_at_1():
    time = 1e-5
    free = propagator(INERTIA, DAMPING, 1.0, time)
    motion = Motion([0.0], [0.0])
    response = []
    for _ in range(20000):
        move(motion, free, 1.0)
        response.append(motion.x[0])
    response = np.array(response)
    peaks = np.flatnonzero((response[1:-1] > response[:-2]) & (response[1:-1] > response[2:])) + 1
    period = (peaks[20] - peaks[0]) * time / 20
    assert 1.0 / period == pytest.approx(666.6, rel=5e-4)
    decrement = math.log((response[peaks[0]] - 1.0) / (response[peaks[20]] - 1.0)) / 20
    assert decrement / (2.0 * math.pi) == pytest.approx(0.017, rel=5e-3)
    assert response[-1] == pytest.approx(1.0, abs=2e-6)  # exp(-71 * 0.2 s) of the step is left


@pytest.mark.parametrize("denominator", [(1e-8, 1.0), (5.7e-8, 8.1e-6, 2.0), (5.7e-8, 0.0, 1.0)])
def test_a_denominator_that_is_none_is_refused(denominator):
    with pytest.raises(ParameterError, match="'denominator' is .*the last 1.0"):
        DynamicsParameters(denominator=denominator)
