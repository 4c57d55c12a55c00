# SPDX-License-Identifier: Apache-2.0
"""Excitation for the identification of hysteresis, and for homing: a sine whose amplitude decays.

The first cycle goes to both ends and makes the plays forget what was before. Every further one turns
a little earlier and leaves other plays moving, down to the smallest: minor loops of all amplitudes
in one recording. At the end every play is within half an amplitude step of 0, so the same profile
homes a finger whose past is unknown.
"""

from __future__ import annotations

import numpy as np

from piezo_control.profile import Profile
from piezo_control.waveform import Waveform


def decaying_sine(
    amplitude: float, cycles: int = 20, frequency_hz: float = 1.0, points_per_cycle: int = 200
) -> Profile:
    """Return a sine of full `amplitude` for one cycle, then falling linearly to 0 at the end.

    Parameters
    ----------
    amplitude : unit of the values: V, or m where a static gain follows
    cycles : number of cycles, at least 2
    frequency_hz : low against the resonance, so that the finger follows statically
    points_per_cycle : points of the profile per cycle, joined by straight lines

    Raises
    ------
    ValueError
        For fewer than 2 cycles or a frequency that is not positive.

    Examples
    --------
    >>> profile = decaying_sine(40.0, cycles=20)
    >>> round(float(profile.value.max()), 9), float(profile.time[-1])
    (40.0, 20.0)
    """
    if cycles < 2:
        raise ValueError(f"cycles is {cycles}, must be at least 2")
    if not frequency_hz > 0.0:
        raise ValueError(f"frequency_hz is {frequency_hz}, must be positive")
    wave = Waveform("decaying_sine", amplitude, frequency_hz, duration=cycles / frequency_hz)
    time = np.arange(cycles * points_per_cycle + 1) / (points_per_cycle * frequency_hz)
    return Profile(time, wave.at(time), linear=True)
