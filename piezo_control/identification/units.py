# SPDX-License-Identifier: Apache-2.0
"""Units as people write them, alone and in the name of a column."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

UNITS = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0,
    "V": 1.0, "mV": 1e-3, "kV": 1e3,
    "m": 1.0, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12,
    "N": 1.0, "mN": 1e-3, "uN": 1e-6,
    "degc": 1.0, "kelvin": 1.0, "degf": 5.0 / 9.0,
}  # fmt: skip
"""Units that are understood, with what makes SI (°C for temperature) of them, beside ZEROS."""
ZEROS = {"kelvin": 273.15, "degf": 32.0}
"""Where 0 °C is."""

SPELLINGS = {
    "µ": "u", "μ": "u", "°C": "degc", "℃": "degc", "degC": "degc", "°K": "kelvin", "°F": "degf", "℉": "degf",
}  # fmt: skip
# Capitals are overlooked in words only: 'Nm' is no nanometre, 'MV' no millivolt.
SYMBOLS = {unit.lower(): unit for unit in UNITS} | {unit: unit for unit in UNITS}
SYMBOLS |= {"K": "kelvin", "F": "degf"}
WORDS = {
    "c": "degc", "celsius": "degc", "degk": "kelvin", "kelvin": "kelvin", "fahrenheit": "degf", "sec": "s", "second": "s", "msec": "ms", "millisec": "ms", "millisecond": "ms",
    "usec": "us", "microsec": "us", "microsecond": "us", "min": "min", "minute": "min", "hr": "h", "hour": "h",
    "mm:ss": "min", "hh:mm": "h", "volt": "V", "vdc": "V", "millivolt": "mV", "kilovolt": "kV", "meter": "m", "metre": "m",
    "millimeter": "mm", "millimetre": "mm", "micrometer": "um", "micrometre": "um", "micron": "um",
    "nanometer": "nm", "nanometre": "nm", "picometer": "pm", "picometre": "pm", "newton": "N", "millinewton": "mN", "micronewton": "uN",
}  # fmt: skip
"""Of a clock, the unit before the colon."""

BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*([^\[\]()]+?)\s*[\])]\s*")
BEHIND = re.compile(r"(.+?)(?:\s*[/,]\s*|_|\s+(?:in\s+)?(?![cC]\s*$))([^\s_/,]+)\s*")
LIKE_UNIT = re.compile(
    r"(?i:([pnuµμmcdk]|nano|micro|milli|centi|kilo|mega)(s|sec|second|m|met(er|re)|v|volt|n|newton|g|gf|hz)s?"
    r"|days?|inch(es)?|mils?|hz|counts?|lsb|percent)|%"
)
"""What ends a heading as a unit does, be it one of UNITS or not."""


def si(values: NDArray[np.float64], unit: str) -> NDArray[np.float64]:
    """Return values in one of UNITS in SI, °C for temperature."""
    zero = ZEROS.get(unit, 0.0)
    return (values - zero if zero else values) * UNITS[unit]


def unit_of(text: str) -> str:
    """Return the unit that `text` spells; `text` itself when it is none of UNITS, '' when it has no letter."""
    text = text.strip().strip("[]()")
    if not re.search(r"[^\W\d_]|[°%]", text):
        return ""
    for spelling, plain in SPELLINGS.items():
        text = text.replace(spelling, plain)
    word = text.lower()
    return SYMBOLS.get(text) or WORDS.get(word) or WORDS.get(word.removesuffix("s"), text)


def split_name(header: str) -> tuple[str, str]:
    """Return name and unit of a heading: 'Voltage (V)', 'x [µm]', 'disp_nm', 'U / V', 'Temp., °C', 'time in ms'."""
    match = BRACKETS.fullmatch(header) or BEHIND.fullmatch(header)
    if match and unit_of(match[2]) in UNITS:
        return match[1].strip(), unit_of(match[2])
    return header.strip(), ""


def said_unit(header: str) -> str:
    """Return the unit in a heading: one of UNITS, a word in brackets or like a unit that is none, or ''."""
    brackets, behind = BRACKETS.fullmatch(header), BEHIND.fullmatch(header)
    if brackets:
        return unit_of(brackets[2])
    if behind and (unit_of(behind[2]) in UNITS or LIKE_UNIT.fullmatch(behind[2])):
        return unit_of(behind[2])
    return ""
