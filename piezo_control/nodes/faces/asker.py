# SPDX-License-Identifier: Apache-2.0
"""What is between the gripper and its faces: who asks for motions, and what they are told."""

from __future__ import annotations

from typing import NamedTuple

from piezo_control.gripper import Outcome


class Measured(NamedTuple):
    """The gripper as the newest states of its fingers have it."""

    opening: float  # m
    velocity: float  # m/s
    force: float  # N, the larger push


class Asker:
    """Somebody who asks the gripper for motions; what one does not care for, one leaves out."""

    def feel(self, measured: Measured) -> None:
        """Take notice of where the motion is, a few times a second."""

    def end(self, outcome: Outcome, measured: Measured) -> None:
        """Take notice of how the motion ended."""

    def is_told(self) -> bool:
        """Say whether the end has reached whom it is for."""
        return True
