# SPDX-License-Identifier: Apache-2.0
"""Drivers: how the servo reaches a sensor and an amplifier.

A driver is a shared library with the functions of ``piezo_driver.h``, given by its path or, if it
comes with the package (``udp``), by its name. Everything that is called in the loop takes plain addresses,
so that it compiles with the loop.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from piezo_control.parameters import ParameterError
from piezo_control.safety import LARGEST_VOLTAGE, is_physical

ABI = 1  # PIEZO_DRIVER_ABI of piezo_driver.h

FRESH, NONE_IN_TIME, FAILED = 0, 1, 2
"""What reading and writing return: a new sample, none within the time limit, the device is gone."""

SHIPPED = Path(__file__).parent / "drivers"


class DriverError(RuntimeError):
    """A device that cannot be opened; the message is the driver's own."""


class Driver(Protocol):
    """A device that is open: what the loop calls, and what is called beside it."""

    device: Any
    """What `read` and `write` take; a named tuple whose array `reading` has the reading and its age (s)."""
    read: Callable[..., int]
    write: Callable[..., int]
    """``read(device, edge)`` and ``write(device, voltage, edge)``, `edge` being the time of the present edge
    (ns); both return what a C driver returns. They are compiled with the loop. A driver may have a method `applied`
    as well, see :func:`applied`."""

    def error(self) -> str:
        """Return what went wrong last."""

    def close(self) -> None:
        """Let go of the device; called again, do nothing."""


class SharedLibrary:
    """A device behind a shared library.

    Raises ParameterError when there is no such library or it lacks a function, DriverError when the device
    does not open.
    """

    def __init__(self, driver: str, options: str, sample_time: float) -> None:
        # Only who opens a device calls it in a compiled loop; who exports the law does without numba.
        from piezo_control.servo.card import Card, read_card, write_card

        path = library(driver)
        try:
            self._functions = ctypes.CDLL(str(path))
            abi = self._functions.piezo_driver_abi
            addresses = [
                ctypes.cast(getattr(self._functions, name), ctypes.c_void_p).value
                for name in ("piezo_read", "piezo_write")
            ]
            self._functions.piezo_open.restype = ctypes.c_void_p
            self._functions.piezo_error.restype = ctypes.c_char_p
            self._functions.piezo_close.restype = None
            self._applied = getattr(self._functions, "piezo_applied", None)
        except (OSError, AttributeError) as error:
            raise ParameterError(f"'driver' is '{driver}': {error}") from None
        if abi() != ABI:
            raise ParameterError(f"'driver' is '{driver}', of ABI {abi()}, must be of ABI {ABI}")
        text = ctypes.create_string_buffer(256)
        self._device = self._functions.piezo_open(
            options.encode(), ctypes.c_double(sample_time), text, ctypes.c_size_t(len(text))
        )
        if not self._device:
            raise DriverError(f"driver '{driver}': {text.value.decode(errors='replace')}")
        read, write = (address or 0 for address in addresses)
        self.device = Card(read, write, self._device, np.zeros(2))
        self.read = read_card
        self.write = write_card

    def error(self) -> str:
        """Return what went wrong last, in the driver's words."""
        if not self._device:
            return ""
        text = self._functions.piezo_error(ctypes.c_void_p(self._device)) or b""
        return text.decode(errors="replace")

    def applied(self) -> float:
        """Return what the card puts out, in its unit; NaN: it does not say."""
        value = ctypes.c_double(math.nan)
        if self._applied and self._applied(ctypes.c_void_p(self._device), ctypes.byref(value)):
            return math.nan
        return value.value

    def close(self) -> None:
        """Let go of the device; called again, do nothing."""
        if self._device:
            self._functions.piezo_close(ctypes.c_void_p(self._device))
            self._device = None


def open_driver(name: str, options: str, sample_time: float) -> Driver:
    """Return the device of a driver, open, for a loop of this sample time (s).

    A driver is a shared library, or what a package names in its entry points `piezo_gripper.drivers`.

    Raises ParameterError for a driver that does not exist, DriverError when the device does not open.
    """
    for entry in entry_points(group="piezo_gripper.drivers", name=name):
        return entry.load()(options, sample_time)
    return SharedLibrary(name, options, sample_time)


def applied(driver: Driver, gain: float, zero: float, otherwise: float = math.nan) -> float:
    """Return what the card of an open driver puts out (V); NaN: nobody says.

    `gain` (V) and `zero` are the amplifier's, `otherwise` what a card that does not say is known to put out, in its
    unit. Raises DriverError for a voltage that no card can mean.
    """
    said = getattr(driver, "applied", lambda: math.nan)()
    said = otherwise if math.isnan(said) else said
    voltage = gain * (said - zero)
    if not math.isnan(said) and not is_physical(voltage, LARGEST_VOLTAGE):
        raise DriverError(
            f"the card says that it puts out {said:g}, which is {voltage:g} V, must be within "
            f"±{LARGEST_VOLTAGE:g} V: gain or zero of the amplifier?"
        )
    return voltage


def library(driver: str) -> Path:
    """Return the file of a driver that is shipped under this name, or else lies at this path."""
    shipped = sorted(SHIPPED.glob(f"{driver}*.so")) if "/" not in driver else []
    path = shipped[0] if shipped else Path(driver)
    if not path.is_file():
        known = sorted({p.name.split(".")[0] for p in SHIPPED.glob("*.so")})
        raise ParameterError(
            f"'driver' is '{driver}', must be 'simulated', one of the shipped {', '.join(known)}, "
            "or the path of a shared library"
        )
    return path.resolve()
