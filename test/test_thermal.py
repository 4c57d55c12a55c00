# SPDX-License-Identifier: Apache-2.0
"""The body follows the thermocouple with a first-order lag, exact at any sample time."""

import math

import pytest

from piezo_sim.plant.thermal import retention, warm


@pytest.mark.parametrize("samples", [1, 7, 3000])
def test_after_one_time_constant_1_minus_1_over_e_is_reached(samples):
    retained = retention(0.3, 0.3 / samples)
    body = 22.0
    for _ in range(samples):
        body = warm(body, retained, 32.0)
    assert body == pytest.approx(32.0 - 10.0 / math.e, abs=1e-9)


def test_without_time_constant_it_follows_at_once():
    assert warm(22.0, retention(0.0, 1e-4), 32.0) == 32.0
