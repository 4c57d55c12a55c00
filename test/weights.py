# SPDX-License-Identifier: Apache-2.0
"""What tests of designs from weights need: slycot, for the design and for python-control to compare it with."""

from importlib.util import find_spec

import pytest

needs_slycot = pytest.mark.skipif(find_spec("slycot") is None, reason="slycot is not installed")
FAST = pytest.param("fast", marks=needs_slycot)  # the shipped controller that comes from weights
