# SPDX-License-Identifier: Apache-2.0
"""Every test session has a ROS domain of its own and stays on this machine."""

import os
import shutil
import signal

import own_domain
import pytest
from hypothesis import HealthCheck, settings

CHROMIUM = shutil.which("chromium")
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
LOG_TAIL = 4000  # characters of a node's log

own_domain.take()

# A shell that starts the tests in the background has these ignored, and so would be the nodes that they start.
for number in (signal.SIGINT, signal.SIGQUIT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)

# Small matrices only: threads of BLAS cost more than they save, above all on a busy machine.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# What is slow says nothing here: on a busy machine everything is.
settings.register_profile("busy", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy")


def pytest_configure(config):
    config.addinivalue_line(
        "markers",
        "shows(row, ...): rows of the table of faults in docs/safety.md that a test shows",
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """Show beside a test that failed what its nodes said."""
    report = yield
    if report.failed and "tmp_path" in item.funcargs:
        for log in sorted(item.funcargs["tmp_path"].rglob("*.log")):
            words = log.read_text(errors="replace")[-LOG_TAIL:]
            report.sections.append((f"end of {log.name}", words))
    return report


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no chromium on this machine (apt install chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="installed where chromium is")
    with playwright.sync_playwright() as p:
        chromium = p.chromium.launch(executable_path=CHROMIUM, args=list(FLAGS))
        yield chromium
        chromium.close()
