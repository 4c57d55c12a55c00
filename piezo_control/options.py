# SPDX-License-Identifier: Apache-2.0
"""What reads the numbers of a command line, and says which are allowed."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path

from piezo_control.files import why_not

LONGEST = 60  # letters of a name that are said


def within(kind: type, low: float, high: float = math.inf) -> Callable[[str], float]:
    """Return what reads an option: a number of a `kind` from `low` to `high`."""

    def number(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is not within [{low:g}, {high:g}]")
        return value

    number.__name__ = kind.__name__  # argparse says "invalid int value" for a text that is none
    return number


def positive(text: str) -> float:
    """Read an option: a finite number above 0."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is not above 0")
    return value


def output_folder(text: str) -> Path:
    """Read an option: a folder to write to, which may have to be made."""
    return _writable(text, is_folder=True)


def output_file(text: str) -> Path:
    """Read an option: a file to write."""
    return _writable(text, is_folder=False)


def _writable(text: str, is_folder: bool) -> Path:
    if reason := why_not(text, is_folder):
        said = text if len(text) <= LONGEST else f"{text[:LONGEST]}…"
        raise argparse.ArgumentTypeError(f"{said!r} {reason}")
    return Path(text)


port = within(int, 0, 65535)
"""Reads the number of a port."""
