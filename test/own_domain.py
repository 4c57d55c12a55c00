# SPDX-License-Identifier: Apache-2.0
"""A ROS domain that no other test session on this machine has."""

import fcntl
import os
import tempfile
from pathlib import Path
from typing import IO

HIGHEST = 101  # safe on every platform, from 1 on
locks: list[IO] = []  # held as long as this process lives


def take() -> None:
    """Take a domain for this process and its children, on this machine alone."""
    for n in range(HIGHEST):
        domain = 1 + (os.getpid() + n) % HIGHEST
        path = Path(tempfile.gettempdir(), f"piezo_gripper_domain_{domain}")
        try:
            lock = path.open("a")
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            continue  # another session's, or another user's
        locks.append(lock)
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        return
    raise RuntimeError(f"all {HIGHEST} ROS domains are taken by test sessions")
