# SPDX-License-Identifier: Apache-2.0
"""Units as people write them, alone and in the name of a column."""

from __future__ import annotations

import re

UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0,
    "V": 1.0, "mV": 1e-3, "kV": 1e3,
    "m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9,
    "N": 1.0, "mN": 1e-3, "uN": 1e-6,
    "degc": 1.0,
}  # fmt: skip
"""Units that are understood, with what makes SI (°C for temperature) of them."""

SPELLINGS = {"µ": "u", "μ": "u", "°C": "degc", "degC": "degc"}
WORDS = {
    "c": "degc", "celsius": "degc", "sec": "s", "second": "s", "millisecond": "ms", "microsecond": "us",
    "minute": "min", "volt": "V", "millivolt": "mV", "kilovolt": "kV", "meter": "m", "metre": "m",
    "millimeter": "mm", "millimetre": "mm", "micrometer": "um", "micrometre": "um", "micron": "um",
    "nanometer": "nm", "nanometre": "nm", "newton": "N", "millinewton": "mN", "micronewton": "uN",
}  # fmt: skip


def unit_of(text: str) -> str:
    """Return the unit that `text` spells, '' when it is none."""
    text = text.strip().strip("[]()")
    for spelling, plain in SPELLINGS.items():
        text = text.replace(spelling, plain)
    return WORDS.get(text.lower().removesuffix("s"), text)


def split_name(header: str) -> tuple[str, str]:
    """Return name and unit of a heading: 'Voltage (V)', 'x [µm]', 'disp_nm', 'U / V', 'Temp., °C'."""
    match = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]\s*", header) or re.fullmatch(
        r"(.+?)\s*(?:[/,]\s*|_)([^\s_/,]+)\s*", header
    )
    if match and unit_of(match[2]) in UNITS:
        return match[1].strip(), unit_of(match[2])
    return header.strip(), ""
