# SPDX-License-Identifier: Apache-2.0
"""Every test session has a ROS domain of its own and stays on this machine."""

import os
import signal

import own_domain

own_domain.take()

# A shell that starts the tests in the background has these ignored, and so would be the nodes that they start.
for number in (signal.SIGINT, signal.SIGQUIT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)

# Small matrices only: threads of BLAS cost more than they save, above all on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_configure(config):
    config.addinivalue_line(
        "markers",
        "shows(row, ...): rows of the table of faults in docs/safety.md that a test shows",
    )
