# SPDX-License-Identifier: Apache-2.0
"""The first schedules of the campaign of faults (`make faults` runs a thousand)."""

import pytest
from faults import run_schedule

# Known defect: after a link that was cut for seconds, the reference may not reach `feedback` again within 30 s.
CUT = pytest.param(15, marks=pytest.mark.xfail(reason="reference lost after a cut link"))


@pytest.mark.parametrize("seed", [*range(15), CUT, *range(16, 25)])
def test_nothing_is_violated(seed, tmp_path):
    assert run_schedule(seed, tmp_path) == []
