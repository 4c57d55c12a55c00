# SPDX-License-Identifier: Apache-2.0
"""The calls of a card's driver: C functions at addresses that are known when the loop runs, compiled with it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic


class Card(NamedTuple):
    """Addresses of a driver's functions and of its open device; `reading` is where a sample goes."""

    read: int
    write: int
    device: int
    reading: np.ndarray  # deflection in the card's unit, age (s)


@intrinsic
def _call_read(_: Any, function: Any, device: Any, reading: Any) -> Any:
    """Call ``int read(device, reading)`` at the address `function`."""
    return types.int32(types.intp, types.intp, types.intp), _caller(("word", "word"))


@intrinsic
def _call_write(_: Any, function: Any, device: Any, voltage: Any) -> Any:
    """Call ``int write(device, voltage)`` at the address `function`."""
    return types.int32(types.intp, types.intp, types.float64), _caller(("word", "double"))


def _caller(arguments: tuple[str, ...]) -> Any:
    """Return code that calls the C function whose address comes first, with such arguments."""

    def generate(_: Any, builder: Any, __: Any, values: Any) -> Any:
        kinds = {"word": ir.IntType(64), "double": ir.DoubleType()}
        signature = ir.FunctionType(ir.IntType(32), [kinds[name] for name in arguments])
        address = builder.inttoptr(values[0], signature.as_pointer())
        return builder.call(address, values[1:])

    return generate


def read_card(card: Card, _: int) -> int:
    """Take a sample into ``card.reading``; return FRESH, NONE_IN_TIME or FAILED."""
    return _call_read(card.read, card.device, card.reading.ctypes.data)


def write_card(card: Card, voltage: float, _: int) -> int:
    """Put out `voltage` (in the card's unit); return FRESH, NONE_IN_TIME or FAILED."""
    return _call_write(card.write, card.device, voltage)
