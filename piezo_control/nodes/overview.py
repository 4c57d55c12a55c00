# SPDX-License-Identifier: Apache-2.0
"""What there is to say of a running finger, for people: a title and a text for each of its figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus

from piezo_control.nodes.client import Finger, Reading, Ros
from piezo_gripper_msgs.action import Grip
from piezo_gripper_msgs.msg import FingerState

IN_ORDER = (FingerState.WAITING, FingerState.RUNNING, FingerState.FINISHED)
Cell = Callable[[Finger, Reading], str]


def figure(value: float, scale: float, digits: int) -> str:
    """Return a number as text."""
    return "-" if math.isnan(value) else f"{value * scale:.{digits}f}"


def of_state(show: Callable[[Any], str]) -> Cell:
    """Return a cell that shows something of the finger's state."""
    return lambda finger, _: show(finger.state) if finger.state else "-"


ROWS: dict[str, Cell] = {
    "does": lambda finger, _: finger.words(),
    "time [s]": lambda _, r: figure(r.time, 1.0, 2),
    "reference [µm]": lambda _, r: figure(r.reference, 1e6, 3),
    "deflection [µm]": lambda _, r: figure(r.deflection, 1e6, 3),
    "command [µm]": lambda _, r: figure(r.command, 1e6, 3),
    "voltage [V]": lambda _, r: figure(r.voltage, 1.0, 2),
    "tip force [mN]": lambda _, r: figure(r.tip_force, 1e3, 3),
    "temperature [°C]": lambda _, r: figure(r.temperature, 1.0, 1),
    "at a limit [samples]": of_state(lambda s: str(s.clipped)),
    "rate [Hz]": of_state(lambda s: figure(s.rate or math.nan, 1.0, 0)),
    "jitter [µs]": of_state(lambda s: figure(s.jitter or math.nan, 1e6, 0)),
    "on target": of_state(lambda s: "yes" if s.on_target else "-"),
}


def in_order(finger: Finger) -> bool:
    """Say whether a finger runs or waits for what is still to come."""
    return finger.state is not None and not finger.is_silent and finger.state.phase in IN_ORDER


def complaints(ros: Ros) -> list[str]:
    """Return what is wrong with any node, in its own words."""
    return [
        f"{name}: {status.message}"
        for name, status in sorted(ros.diagnostics.items())
        if status.level != DiagnosticStatus.OK
    ]


def ended(result: Grip.Result) -> str:
    """Return how a motion of a gripper ended."""
    how = "there" if result.reached_goal else "stopped before" if result.stalled else "given up"
    return f"{how}: opening {result.opening * 1e6:.2f} µm, force {result.force * 1e3:.3f} mN"
