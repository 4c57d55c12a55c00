# SPDX-License-Identifier: Apache-2.0
"""A run of a finger as arrays over time, read from a bag."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piezo_control.profile import Profile, Signal
from piezo_control.recording.reader import Bag, BagError, open_bag
from piezo_control.waveform import Waveform

__all__ = ["BagError", "Recording", "read"]

SAMPLE_TYPE = "piezo_gripper_msgs/msg/Sample"
PROFILE_TYPE = "piezo_gripper_msgs/msg/Profile"
WAVEFORM_TYPE = "piezo_gripper_msgs/msg/Waveform"
BLOCK_TYPE = "piezo_gripper_msgs/msg/SampleBlock"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"
LINEAR = 1  # Profile.interpolation: straight lines


@dataclass(frozen=True)
class Recording:
    """Signals of one run of one finger, 1-D arrays of shape (n,), NaN where a signal was not recorded.

    `time` counts in seconds from the first sample and `number` are the samples' numbers; deflection,
    reference and command are in m, voltage in V, tip_force (external) in N, temperature in °C. Deflection
    k is what the sensor said at time[k]; command and voltage k are the answer to it, in force from then
    on until the next. `limited` is 1 where a limit acted on command or voltage k, else 0.
    """

    number: NDArray[np.int64]
    time: NDArray[np.float64]
    reference: NDArray[np.float64]
    deflection: NDArray[np.float64]
    command: NDArray[np.float64]
    voltage: NDArray[np.float64]
    limited: NDArray[np.float64]
    temperature: NDArray[np.float64]
    tip_force: NDArray[np.float64]

    @property
    def sample_time(self) -> float:
        """Time from sample to sample in s: the median, in whole nanoseconds."""
        return _period(self.time, self.number)


def read(
    path: str | Path, finger: str = "", run: int | None = None, partial: bool = False
) -> Recording:
    """Read a run from a rosbag2 folder (MCAP or SQLite), or from one such storage file.

    Samples are brought in line by their numbers; those that a topic does not have are NaN, repeated
    ones count once. References and tip forces are evaluated from their profile or waveform, or held from
    set-point to set-point; temperatures are held from stamp to stamp.

    Parameters
    ----------
    path : str or Path
        Written by the recorder node, the engine or ``ros2 bag record``; stamps may be simulated time or
        that of a wall clock.
    finger : str
        Namespace; may be left out when the bag holds one finger.
    run : int, optional
        Which run, from 0, of a bag in which the numbers of the samples start again.
    partial : bool
        Take what there is of a damaged bag instead of raising BagError.

    Raises
    ------
    BagError
        If this is no bag or a damaged one, holds no deflection, holds several fingers or runs and none
        was named, or a topic has another message type than a finger's. The message says what is there.
    """
    bag = open_bag(path)
    if bag.damage and not partial:
        raise BagError(
            f"{path}: {bag.damage}; could be read: {bag.content()}; to use that, ask for a partial reading"
        )
    prefix = _prefix(bag, finger)
    signals = _from_blocks(bag, prefix, run) or _from_samples(bag, prefix, run)
    number, stamps, received = (signals.pop(name) for name in ("number", "stamps", "received"))
    elapsed = number * _period((stamps - stamps[0]) * 1e-9, number)
    for name in ("reference", "tip_force"):
        if name not in signals:
            signals[name] = _signal(bag, prefix + name, received, elapsed)
    warmth = bag.messages(f"{prefix}temperature", TEMPERATURE_TYPE)
    recording = Recording(
        number=number,
        time=(stamps - stamps[0]) * 1e-9,
        temperature=_held(
            [_nanoseconds(m.header.stamp) for m in warmth], [m.temperature for m in warmth], stamps
        ),
        **signals,
    )
    return _without_ragged_end(recording) if bag.damage else recording


def _without_ragged_end(recording: Recording) -> Recording:
    """Cut off the last samples, for which some of the signals that were recorded are missing."""
    signals = {f.name: getattr(recording, f.name) for f in fields(recording)}
    present = [np.flatnonzero(np.isfinite(signal)) for signal in signals.values()]
    end = min(samples[-1] + 1 for samples in present if samples.size)
    return Recording(**{name: signal[:end] for name, signal in signals.items()})


def _prefix(bag: Bag, finger: str) -> str:
    """Return the namespace of the finger in the bag, with its '/'."""
    last = ("deflection", "samples")
    found = sorted({t[: -len(t.split("/")[-1])] for t in bag.topics if t.split("/")[-1] in last})
    if finger:
        found = [prefix for prefix in found if prefix == f"/{finger.strip('/')}/"]
    if len(found) != 1:
        which = "several fingers, name one of" if found else f"no topic '{finger}/deflection' in"
        raise BagError(f"{bag.path}: {which}: {bag.content()}")
    topics = [found[0] + name for name in last if found[0] + name in bag.topics]
    if not any(bag.topics[topic].data for topic in topics):
        raise BagError(
            f"{bag.path}: topic '{topics[0]}' has no messages; there is: {bag.content()}"
        )
    return found[0]


def _from_blocks(bag: Bag, prefix: str, run: int | None) -> dict[str, NDArray]:
    """Return number, stamps (ns) and signals of a loop that was recorded in blocks; nothing if it was not."""
    topic = f"{prefix}samples"
    blocks = bag.messages(topic, BLOCK_TYPE)
    if not blocks:
        return {}
    blocks = blocks[_choose_run(bag, topic, blocks, run)]
    counts = [np.arange(len(block.deflection)) for block in blocks]
    number = np.concatenate([block.number + n for block, n in zip(blocks, counts)])
    stamps = [
        _nanoseconds(b.header.stamp) + np.round(1e9 * b.period * n).astype(np.int64)
        for b, n in zip(blocks, counts)
    ]
    names = ("reference", "deflection", "command", "voltage")
    signals = {name: np.concatenate([getattr(b, name) for b in blocks]) for name in names}
    signals["stamps"] = np.concatenate(stamps)
    signals["limited"] = np.full(signals["voltage"].shape, np.nan)  # blocks do not say
    signals["received"] = signals["stamps"]
    number, first = np.unique(number.astype(np.int64), return_index=True)
    return {"number": number, **{name: signal[first] for name, signal in signals.items()}}


def _from_samples(bag: Bag, prefix: str, run: int | None) -> dict[str, NDArray]:
    """Return number, stamps (ns) and signals of a loop that was recorded sample by sample."""
    topic = f"{prefix}deflection"
    messages = bag.messages(topic, SAMPLE_TYPE)
    chosen = _choose_run(bag, topic, messages, run)
    deflection, received = messages[chosen], np.array(bag.topics[topic].stamps[chosen])
    number, first = np.unique([m.number for m in deflection], return_index=True)
    stamps = np.array([_nanoseconds(deflection[i].header.stamp) for i in first])
    commands, voltages = (bag.messages(prefix + n, SAMPLE_TYPE) for n in ("command", "voltage"))
    return {
        "number": number,
        "stamps": stamps,
        "received": received[first],
        "deflection": np.array([deflection[i].value for i in first]),
        "command": _align(number, commands, stamps, "value"),
        "voltage": _align(number, voltages, stamps, "value"),
        "limited": np.maximum(
            *(_align(number, answers, stamps, "limited") for answers in (commands, voltages))
        ),
    }


def _choose_run(bag: Bag, topic: str, messages: list[Any], run: int | None) -> slice:
    """Return which messages are those of one run; where numbers go back, another one begins."""
    number = np.array([m.number for m in messages])
    begins = [0, *np.flatnonzero(np.diff(number) < 0) + 1, number.size]
    count = len(begins) - 1
    if run is None and count > 1 or run is not None and not 0 <= run < count:
        raise BagError(
            f"{bag.path}: topic '{topic}' has {count} runs (numbered from 0), and run {run} was asked for"
        )
    return slice(int(begins[run or 0]), int(begins[(run or 0) + 1]))


def _period(time: NDArray, number: NDArray) -> float:
    if number.size < 2:
        return 0.0
    return round(float(np.median(np.diff(time) / np.diff(number))) * 1e9) / 1e9


def _nanoseconds(stamp: Any) -> int:
    # A float of seconds on the clock on the wall has steps of a quarter of a microsecond.
    return stamp.sec * 10**9 + stamp.nanosec


def _align(number: NDArray, samples: list[Any], stamps: NDArray, field: str) -> NDArray[np.float64]:
    """Return a field of the sample `number`s, looked for between the first and the last stamp."""
    values = {
        m.number: getattr(m, field)
        for m in samples
        if stamps[0] <= _nanoseconds(m.header.stamp) <= stamps[-1]
    }
    return np.array([values.get(n, np.nan) for n in number.tolist()], float)


def _signal(bag: Bag, name: str, received: NDArray, elapsed: NDArray) -> NDArray[np.float64]:
    """Evaluate a signal that came as profiles, waveforms (over the time `elapsed`) and set-points.

    The newest counts, and each is in force from when it came, by the bag's own stamps, as are the samples (`received`, ns). A
    profile that came first says what was before it, too.
    """
    came: list[tuple[int, bool, Signal]] = []
    types = {f"{name}_profile": PROFILE_TYPE, f"{name}_waveform": WAVEFORM_TYPE, name: SAMPLE_TYPE}
    for topic, kind in types.items():
        messages = bag.messages(topic, kind)
        for m, instant in zip(messages, bag.topics[topic].stamps if messages else ()):
            if kind == PROFILE_TYPE:
                came.append((instant, True, Profile(m.time, m.value, m.interpolation == LINEAR)))
            elif kind == WAVEFORM_TYPE:
                came.append((instant, False, Waveform.of(m)))
            else:
                came.append((instant, False, Profile([0.0], [m.value])))
    came.sort(key=lambda one: one[0])
    values = np.full(elapsed.shape, np.nan)
    for i, (instant, is_profile, signal) in enumerate(came):
        first = 0 if i == 0 and is_profile else int(np.searchsorted(received, instant))
        values[first:] = signal.at(elapsed[first:])
    return values


def _held(instants: list[int], values: list[float], stamps: NDArray) -> NDArray[np.float64]:
    """Return what was newest at each of `stamps`, NaN before the first."""
    if not instants:
        return np.full(stamps.shape, np.nan)
    order = np.argsort(instants, kind="stable")
    index = np.searchsorted(np.array(instants)[order], stamps + 1, side="right") - 1
    return np.where(index >= 0, np.array(values)[order][np.maximum(index, 0)], np.nan)
