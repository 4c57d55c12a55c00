# SPDX-License-Identifier: Apache-2.0
"""What the columns of a table may hold, with their units, and how a command line names them."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from piezo_control.options import within

QUANTITIES = {  # the units a column may have, the first of them where nothing says which
    "time": ("s", "ms", "us", "min", "h"),
    "voltage": ("V", "mV", "kV"),
    "deflection": ("m", "mm", "um", "nm", "pm"),
    "temperature": ("degc", "kelvin", "degf"),
    "tip_force": ("N", "mN", "uN"),
}
LOOP = {**QUANTITIES, "reference": QUANTITIES["deflection"], "command": QUANTITIES["deflection"]}
"""The same, and what a loop has beside."""


def add_options(parser: argparse.ArgumentParser, quantities: Mapping[str, tuple[str, ...]]) -> None:
    """Add what names the columns of a table on the command line; :func:`chosen_columns` reads it."""
    group = parser.add_argument_group(
        "tables",
        "text, .xlsx, .mat, .h5, .tdms, .npz or .parquet; COLUMN is a name, a part of one, or a number from 0",
    )
    for quantity, units in quantities.items():
        group.add_argument(
            f"--{quantity.replace('_', '-')}", dest=f"column_{quantity}", metavar="COLUMN[:UNIT]",
            help=f"column of the {quantity.replace('_', ' ')}; units {', '.join(units)}",
        )  # fmt: skip
    group.add_argument(
        "--sample-rate", type=within(float, 1e-6, 1e9), metavar="HZ",
        help="rows come evenly; takes the place of a column with the time",
    )  # fmt: skip


def chosen_columns(
    arguments: argparse.Namespace, quantities: Mapping[str, tuple[str, ...]]
) -> tuple[dict[str, str], float | None]:
    """Return the columns and the time between rows (s) that a command line names."""
    given = {quantity: getattr(arguments, f"column_{quantity}") for quantity in quantities}
    named = {quantity: column for quantity, column in given.items() if column}
    return named, 1.0 / arguments.sample_rate if arguments.sample_rate else None
