# SPDX-License-Identifier: Apache-2.0
"""Waiting for the edges of a clock that never stands still, and the privileges that make it exact.

The functions with plain arguments are compiled with the loop that calls them; they call the C library
directly, so nothing of Python is involved while the loop runs.
"""

from __future__ import annotations

import ctypes
import os
from typing import Any, NamedTuple

import numpy as np
from numba import types

CLOCK_MONOTONIC = 1
TIMER_ABSTIME = 1
MCL_CURRENT = 1
PR_SET_TIMERSLACK = 29

LATENESS_BIN_NS = 1000
LATENESS_BINS = 2000

_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))
_clock_nanosleep: Any = types.ExternalFunction(
    "clock_nanosleep", types.int32(types.int32, types.int32, types.intp, types.intp)
)


class Clock(NamedTuple):
    """Period and edges (ns of the monotonic clock), and how late the loop began its periods.

    The arrays hold one integer each, but `timespec` two and `lateness` a histogram with bins of 1 µs, the
    last of which counts everything beyond.
    """

    period: int
    spin: int  # how long before the edge the sleep ends
    edge: np.ndarray
    number: np.ndarray  # of the edge, since the start
    missed: np.ndarray  # edges that were never served
    lateness: np.ndarray
    timespec: np.ndarray


def clock_of(period: float, spin: float) -> Clock:
    """Return a clock of this period and spin time (s) that has not begun."""
    sizes = {"edge": 1, "number": 1, "missed": 1, "lateness": LATENESS_BINS, "timespec": 2}
    arrays = {name: np.zeros(size, dtype=np.int64) for name, size in sizes.items()}
    return Clock(round(period * 1e9), round(spin * 1e9), **arrays)


def now(clock: Clock) -> int:
    """Return the time of the monotonic clock (ns)."""
    _clock_gettime(CLOCK_MONOTONIC, clock.timespec.ctypes.data)
    return clock.timespec[0] * 1000000000 + clock.timespec[1]


def begin(clock: Clock) -> None:
    """Let edge -1 be now, so that edge 0 comes in a period."""
    clock.edge[0] = now(clock)
    clock.number[0] = -1


def wait_for_edge(clock: Clock) -> int:
    """Wait for the next edge and return how late (ns) it is served.

    Edges lie on a fixed grid. Those that passed more than half a period ago are counted as missed and left
    out: the loop never runs after lost time in a burst.
    """
    edge = clock.edge[0] + clock.period
    instant = now(clock)
    missed = (instant - edge + clock.period // 2) // clock.period
    if missed > 0:
        edge += missed * clock.period
        clock.missed[0] += missed
        clock.number[0] += missed
    if edge - instant > clock.spin:
        wake = edge - clock.spin
        clock.timespec[0] = wake // 1000000000
        clock.timespec[1] = wake % 1000000000
        _clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, clock.timespec.ctypes.data, 0)
        instant = now(clock)
    while instant < edge:
        instant = now(clock)
    clock.edge[0] = edge
    clock.number[0] += 1
    late = instant - edge
    clock.lateness[min(late // LATENESS_BIN_NS, LATENESS_BINS - 1)] += 1
    return late


def lateness_quantile(lateness: np.ndarray, share: float) -> float:
    """Return the lateness (s) that this share of the periods does not exceed, by the bin's upper end."""
    total = lateness.sum()
    if not total:
        return 0.0
    index = int(np.searchsorted(np.cumsum(lateness), share * total))
    return (index + 1) * LATENESS_BIN_NS * 1e-9


def become_real_time(priority: int, cpu: int) -> str:
    """Put this thread under the real-time scheduler and keep the process' memory from being paged out.

    `priority` is that of SCHED_FIFO, 1 to 99, or 0 for the ordinary scheduler; `cpu` the one to stay on,
    or -1. Returns what could not be done and what to set for it; empty when all was done.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0)
    refused = []
    if priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except PermissionError:
            refused.append(f"SCHED_FIFO {priority} (set 'rtprio {priority}')")
        if libc.mlockall(MCL_CURRENT):
            refused.append("locked memory (set 'memlock unlimited')")
    if cpu >= 0:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError:
            cpus = ", ".join(map(str, sorted(os.sched_getaffinity(0))))
            refused.append(f"CPU {cpu} (this process may use {cpus})")
    if not refused:
        return ""
    return f"not in real time: no {', no '.join(refused)}; see /etc/security/limits.conf"
