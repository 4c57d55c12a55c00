# SPDX-License-Identifier: Apache-2.0
"""Every test session has a ROS domain of its own and stays on this machine."""

import os

import own_domain

own_domain.take()

# Small matrices only: threads of BLAS cost more than they save, above all on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_configure(config):
    config.addinivalue_line(
        "markers",
        "shows(row, ...): rows of the table of faults in docs/safety.md that a test shows",
    )
