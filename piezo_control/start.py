# SPDX-License-Identifier: Apache-2.0
"""Starts the executables, and tells them when to end: Ctrl-C during their imports ends them without a traceback."""

from __future__ import annotations

import atexit
import ctypes
import importlib
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.metadata import requires
from io import TextIOWrapper
from pathlib import Path
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
# What comes with another package, or is called otherwise there.
PART_OF = {
    "llvmlite": "numba",
    "lz4": "rosbags",
    "tornado": "bokeh",
    "yaml": "pyyaml",
    "zstandard": "rosbags",
}
LOOK_PERIOD = 0.02  # s, between two looks at whether a signal came
FREEING = 5.0  # s that the middleware may take to free what a program has had of it
CLOCK_MONOTONIC, SIGEV_THREAD = 1, 2  # of <time.h> and <signal.h>


class Stop:
    """Whether it is time to end; set by a signal, or by hand.

    The handler of a signal runs between any two steps of the main thread, those of another handler included. So it
    sets a plain value: the lock of a threading.Event could be held by the very thread that then waits for it.
    """

    def __init__(self) -> None:
        self._is_set = False

    def set(self, *_: Any) -> None:
        """Say that it is time to end; may be called in the handler of a signal."""
        self._is_set = True

    def is_set(self) -> bool:
        """Say whether it is time to end."""
        return self._is_set

    def wait(self, timeout: float) -> bool:
        """Wait for as long as `timeout` (s) until it is time to end, and say whether it is."""
        end = time.monotonic() + timeout
        while not self._is_set and time.monotonic() < end:
            time.sleep(LOOK_PERIOD)
        return self._is_set


def interrupt_at_signals() -> None:
    """Raise KeyboardInterrupt at the first signal that ends a program, and ignore those that follow.

    For what waits for answers and computes for long between its movements; `finally` leads the finger to rest.
    """

    def interrupt(*_: Any) -> None:
        for number in caught:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    caught = [number for number in ENDING if signal.getsignal(number) is not signal.SIG_IGN]
    for number in caught:
        signal.signal(number, interrupt)


def stop_at_signals() -> Stop:
    """Return what the signals that end a program set; call from the main thread.

    SIGHUP comes from a terminal that is closed; a program started with nohup has it ignored. So are all of them
    while Python ends: it gives them back their default, and a second signal would turn a good end into a death.
    """
    stop = Stop()
    for number in ENDING:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, stop.set)
            atexit.register(signal.signal, number, signal.SIG_IGN)
    return stop


class SignalEvent(ctypes.Structure):
    """The `struct sigevent` of Linux, for a timer that calls a function in a thread of its own."""

    _fields_ = (
        ("value", ctypes.c_void_p),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("rest", ctypes.c_char * 32),
    )


def end_within(seconds: float, code: int) -> Callable[[], None]:
    """End the program with an exit code in `seconds`, whatever it does then; what is returned calls that off.

    Fast DDS hangs now and then where it is freed in the very moment in which other programs leave too, as after one
    Ctrl-C for all: it waits for its own discovery, which waits for it. It has the interpreter's lock meanwhile, so that
    neither a thread nor a signal's handler in Python could end that; the timer of the system calls `_exit` by itself.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    last_step = ctypes.cast(libc._exit, ctypes.c_void_p)
    event = SignalEvent(code, 0, SIGEV_THREAD, last_step, None)
    timer = ctypes.c_void_p()
    if libc.timer_create(CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) != 0:
        raise OSError(ctypes.get_errno(), "no timer")
    once = (ctypes.c_long * 4)(0, 0, int(seconds), round(seconds % 1.0 * 1e9))
    libc.timer_settime(timer, 0, ctypes.byref(once), None)
    return partial(libc.timer_delete, timer)


@contextmanager
def over_within(seconds: float, code: int) -> Iterator[None]:
    """End the program with an exit code where what is done here, when its work is done, takes longer than `seconds`."""
    call_off = end_within(seconds, code)
    try:
        yield
    finally:
        call_off()


def how_to_get(package: str) -> str:
    """Return in a few words how a Python package gets here that one of the programs imports."""
    package = PART_OF.get(package, package)
    declared = [re.split(r"[^\w.-]", line)[0].lower() for line in requires("piezo_gripper") or []]
    if package in declared:
        return f"needs {package}: pip install {package}"
    return (
        f"needs {package}: source the setup.bash of ROS 2 Jazzy and of the workspace, or that of a "
        "checkout after 'make env'"
    )


def executable(module: str) -> Callable[[], int]:
    """Return a function that imports `module` and runs its `main`.

    What is missing or what the machine refuses, a package or a full disk, is said in a line, with exit code 1; letters that
    the terminal does not have, such as µ, stand there as '?'.
    """

    def start() -> int:
        # Nothing moves a finger yet; what does sets handlers of its own that bring it to rest.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        if isinstance(sys.stdout, TextIOWrapper):
            sys.stdout.reconfigure(errors="replace")
        try:
            return importlib.import_module(module).main()
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package in ("", "piezo_control", "piezo_sim"):
                raise
            print(f"{Path(sys.argv[0]).name}: {how_to_get(package)}", file=sys.stderr)
        except OSError as error:
            print(f"{Path(sys.argv[0]).name}: {error}", file=sys.stderr)
        return 1

    return start


commission = executable("piezo_control.servo.commission")
export = executable("piezo_control.export.cli")
feedback = executable("piezo_control.nodes.feedback")
fingerctl = executable("piezo_control.nodes.fingerctl")
feedforward = executable("piezo_control.nodes.feedforward")
gripper = executable("piezo_control.nodes.gripper")
identify = executable("piezo_control.identification.cli")
panel = executable("piezo_control.nodes.panel")
recorder = executable("piezo_control.nodes.recorder")
synthesize = executable("piezo_control.design.cli")
servo = executable("piezo_control.nodes.servo")
