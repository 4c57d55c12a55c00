# SPDX-License-Identifier: Apache-2.0
"""A run of a finger as arrays over time, read from a bag."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piezo_control.profile import Profile, Signal
from piezo_control.recording.reader import Bag, BagError, Topic, open_bag
from piezo_control.waveform import Waveform

__all__ = ["BagError", "Recording", "read"]

SAMPLE_TYPE = "piezo_gripper_msgs/msg/Sample"
PROFILE_TYPE = "piezo_gripper_msgs/msg/Profile"
WAVEFORM_TYPE = "piezo_gripper_msgs/msg/Waveform"
BLOCK_TYPE = "piezo_gripper_msgs/msg/SampleBlock"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"
LINEAR = 1  # Profile.interpolation: straight lines
LOOP = ("reference", "deflection", "command", "voltage")


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

    def part(self, samples: slice | NDArray) -> Recording:
        """Return the recording of these samples only."""
        return Recording(**{f.name: getattr(self, f.name)[samples] for f in fields(self)})

    def complete(self) -> tuple[Recording, str]:
        """Return the samples at which every signal of the loop is known, and what is left out for that, in words.

        A signal that was not recorded at all is no reason to leave out a sample. Before the first one that is
        known, the temperature was the same and the tip force 0.
        """
        lost = {n: np.isnan(getattr(self, n)) for n in LOOP if np.isfinite(getattr(self, n)).any()}
        whole = ~np.any(list(lost.values()), axis=0)
        known = np.flatnonzero(whole)
        if not known.size:
            raise BagError(f"no sample has all of {', '.join(lost)}")
        places = {
            "at the beginning": slice(0, known[0]),
            "at the end": slice(known[-1] + 1, None),
            "in between": slice(known[0], known[-1] + 1),
        }
        left_out = []
        for place, samples in places.items():
            count = int(np.sum(~whole[samples]))
            missing = [name for name in lost if lost[name][samples].any()]
            if count:
                left_out.append(f"{count:,} {place}, without {' or '.join(missing)}")
        words = [f"left out: {'; '.join(left_out)}"] if left_out else []
        if self.number[0] > 0:
            words.append(f"the bag begins at sample {self.number[0]:,}")
        step = int(np.median(np.diff(self.number))) if self.number.size > 1 else 1
        absent = int((self.number[-1] - self.number[0]) // step + 1 - self.number.size)
        if absent > 0:
            words.append(
                f"{absent:,} of {self.number.size + absent:,} samples were not recorded, the first is "
                f"{self.number[np.argmax(np.diff(self.number) > step)] + step:,}"
            )
        kept = self.part(whole)
        return replace(
            kept,
            temperature=_from_the_beginning(kept.temperature),
            tip_force=_from_the_beginning(kept.tip_force, 0.0),
        ), "; ".join(words)


def read(
    path: str | Path, finger: str = "", run: int | None = None, partial: bool = False
) -> Recording:
    """Read a run from a rosbag2 folder (MCAP or SQLite), or from one such storage file.

    Samples are brought in line by their numbers; those that a topic does not have are NaN, repeated
    ones count once. The reference is the one that was followed; tip forces are evaluated from their profile or
    waveform, or held from set-point to set-point; temperatures are held from stamp to stamp.

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
    bag = _of_run(bag, prefix, run)
    signals = _from_blocks(bag, prefix) or _from_samples(bag, prefix)
    number, stamps, received = (signals.pop(name) for name in ("number", "stamps", "received"))
    elapsed = number * _period((stamps - stamps[0]) * 1e-9, number)
    if "reference" not in signals:
        signals["reference"] = _reference(bag, prefix, stamps, received, elapsed)
    signals["tip_force"] = _signal(bag, f"{prefix}tip_force", received, elapsed)
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
    signals = [getattr(recording, f.name) for f in fields(recording)]
    present = [np.flatnonzero(np.isfinite(signal)) for signal in signals]
    return recording.part(slice(min(samples[-1] + 1 for samples in present if samples.size)))


def _from_the_beginning(values: NDArray, before: float | None = None) -> NDArray[np.float64]:
    """Return `values` with `before`, or their first known one, where they are not known yet."""
    known = np.flatnonzero(np.isfinite(values))
    if not known.size:
        return values
    filled = values.copy()
    filled[: known[0]] = values[known[0]] if before is None else before
    return filled


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


def _of_run(bag: Bag, prefix: str, run: int | None) -> Bag:
    """Return what a bag holds of one run: where the samples' numbers go back, another one begins.

    What was sent before a run and is numbered by none, a reference, a temperature, may last into it.
    """
    name, kind = f"{prefix}samples", BLOCK_TYPE
    if not bag.messages(name, kind):
        name, kind = f"{prefix}deflection", SAMPLE_TYPE
    number = np.array([m.number for m in bag.messages(name, kind)])
    begins = [0, *np.flatnonzero(np.diff(number) < 0) + 1]
    if run is None and len(begins) > 1 or run is not None and not 0 <= run < len(begins):
        asked = "name one of them" if run is None else f"there is no run {run}"
        raise BagError(
            f"{bag.path}: topic '{name}' has {len(begins)} runs, numbered from 0: {asked}"
        )
    if len(begins) == 1:
        return bag
    edges = [*(bag.topics[name].stamps[i] for i in begins), np.inf]
    begin, until = edges[run or 0], edges[(run or 0) + 1]
    numbered = {prefix + signal for signal in ("samples", *LOOP[1:])}
    numbered |= {f"{prefix}reference_followed_{form}" for form in ("profile", "waveform")}
    topics = {}
    for name, topic in bag.topics.items():
        kept = [
            i
            for i, s in enumerate(topic.stamps)
            if s < until and (s >= begin or name not in numbered)
        ]
        topics[name] = Topic(
            topic.type, [topic.stamps[i] for i in kept], [topic.data[i] for i in kept]
        )
    return replace(bag, topics=topics)


def _from_blocks(bag: Bag, prefix: str) -> dict[str, NDArray]:
    """Return number, stamps (ns) and signals of a loop that was recorded in blocks; nothing if it was not."""
    topic = f"{prefix}samples"
    blocks = bag.messages(topic, BLOCK_TYPE)
    if not blocks:
        return {}
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


def _from_samples(bag: Bag, prefix: str) -> dict[str, NDArray]:
    """Return number, stamps (ns) and signals of a loop that was recorded sample by sample."""
    topic = f"{prefix}deflection"
    deflection = bag.messages(topic, SAMPLE_TYPE)
    received = np.array(bag.topics[topic].stamps)
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


def _reference(
    bag: Bag, prefix: str, stamps: NDArray, received: NDArray, elapsed: NDArray
) -> NDArray[np.float64]:
    """Return the reference by what the feedback said it follows and from which sample on.

    Where it said nothing, by what was sent to it and when that came.
    """
    values = np.full(elapsed.shape, np.nan)
    said = _sent(bag, f"{prefix}reference_followed")
    for _, stamp, signal in sorted(said, key=lambda one: one[1]):
        first = int(np.searchsorted(stamps, stamp))
        values[first:] = signal.at(elapsed[first:])
    return np.where(np.isnan(values), _signal(bag, f"{prefix}reference", received, elapsed), values)


def _sent(bag: Bag, name: str) -> list[tuple[int, int, Signal]]:
    """Return the bag's stamp, the message's own (ns) and the signal of all profiles, waveforms and set-points."""
    kinds: dict[str, tuple[str, Callable[[Any], Signal]]] = {
        f"{name}_profile": (PROFILE_TYPE, lambda m: Profile(m.time, m.value, m.interpolation == LINEAR)),
        f"{name}_waveform": (WAVEFORM_TYPE, Waveform.of),
        name: (SAMPLE_TYPE, lambda m: Profile([0.0], [m.value])),
    }  # fmt: skip
    return [
        (came, _nanoseconds(m.header.stamp), signal(m))
        for topic, (kind, signal) in kinds.items()
        if topic in bag.topics
        for came, m in zip(bag.topics[topic].stamps, bag.messages(topic, kind))
    ]


def _signal(bag: Bag, name: str, received: NDArray, elapsed: NDArray) -> NDArray[np.float64]:
    """Evaluate a signal that came as profiles, waveforms (over the time `elapsed`) and set-points.

    The newest counts, and each is in force from when it came, by the bag's own stamps, as are the samples
    (`received`, ns). A profile that came first says what was before it, too.
    """
    came = sorted(_sent(bag, name), key=lambda one: one[0])
    values = np.full(elapsed.shape, np.nan)
    for i, (instant, _, signal) in enumerate(came):
        is_there = (
            i == 0
            and f"{name}_profile" in bag.topics
            and (instant in bag.topics[f"{name}_profile"].stamps)
        )
        first = 0 if is_there else int(np.searchsorted(received, instant))
        values[first:] = signal.at(elapsed[first:])
    return values


def _held(instants: list[int], values: list[float], stamps: NDArray) -> NDArray[np.float64]:
    """Return what was newest at each of `stamps`, NaN before the first."""
    if not instants:
        return np.full(stamps.shape, np.nan)
    order = np.argsort(instants, kind="stable")
    index = np.searchsorted(np.array(instants)[order], stamps + 1, side="right") - 1
    return np.where(index >= 0, np.array(values)[order][np.maximum(index, 0)], np.nan)
