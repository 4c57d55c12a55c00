# SPDX-License-Identifier: Apache-2.0
"""From a measurement of an actuator to its parameters."""

import os

# Many small matrices: the threads of BLAS, started with numpy, would make a fit ten times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")
