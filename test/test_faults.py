# SPDX-License-Identifier: Apache-2.0
"""The first schedules of the campaign of faults (`make faults` runs a thousand)."""

import pytest
from faults import run_schedule


@pytest.mark.parametrize("seed", range(25))
def test_nothing_is_violated(seed, tmp_path):
    assert run_schedule(seed, tmp_path) == []
