"""A run as arrays over time, read from a bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader, AnyReaderError

from piezo_control.profile import Profile

LINEAR = 1  # Profile.interpolation: straight lines
SAMPLED = ("deflection", "command", "voltage")


class BagError(ValueError):
    """A bag that cannot be read as a finger's run; the message names bag, topic and what was found."""


@dataclass(frozen=True)
class Recording:
    """Signals of one run of one finger, arrays of shape (n,), NaN where a signal was not recorded.

    `time` counts in seconds from the first sample; deflection, reference and command are in m, voltage
    in V, tip_force (external) in N, temperature in °C. Sample k of voltage was applied from time[k] on.
    """

    time: NDArray[np.float64]
    reference: NDArray[np.float64]
    deflection: NDArray[np.float64]
    command: NDArray[np.float64]
    voltage: NDArray[np.float64]
    temperature: NDArray[np.float64]
    tip_force: NDArray[np.float64]


def read(bag: str | Path, finger: str = "") -> Recording:
    """Read the run of `finger` (a namespace; may be left out when the bag holds one finger).

    Samples are brought in line by their numbers; those that a topic does not have are NaN. References
    and tip forces are evaluated from their profile or held from set-point to set-point, temperatures are
    held from stamp to stamp.

    Raises
    ------
    BagError
        If the folder is no bag or is unreadable, holds no deflection, holds several fingers and none
        was named, or a topic has another message type than a finger's.
    """
    messages = _messages(Path(bag))
    topic = _deflection_topic(bag, list(messages), finger)
    prefix = topic[: -len("deflection")]
    finger_topics = {t[len(prefix) :]: m for t, m in messages.items() if t.startswith(prefix)}
    deflection = finger_topics["deflection"]
    if not deflection:
        raise BagError(f"{bag}: topic '{topic}' has no messages")
    try:
        numbers = np.array([m.number for m in deflection])
        stamps = np.array([_seconds(m) for m in deflection])
        sampled = {name: _align(numbers, finger_topics.get(name, [])) for name in SAMPLED}
        return Recording(
            time=stamps - stamps[0],
            reference=_signal(finger_topics, "reference", stamps),
            temperature=_held(
                [_seconds(m) for m in finger_topics.get("temperature", [])],
                [m.temperature for m in finger_topics.get("temperature", [])],
                stamps,
            ),
            tip_force=_signal(finger_topics, "tip_force", stamps),
            **sampled,
        )
    except AttributeError as error:
        raise BagError(f"{bag}: not recorded from a finger of this package: {error}") from None


def _messages(bag: Path) -> dict[str, list[Any]]:
    try:
        with AnyReader([bag]) as reader:
            messages: dict[str, list[Any]] = {c.topic: [] for c in reader.connections}
            for connection, _, data in reader.messages():
                messages[connection.topic].append(reader.deserialize(data, connection.msgtype))
    except (AnyReaderError, OSError) as error:
        raise BagError(f"{bag}: cannot be read as a bag: {error}") from None
    return messages


def _deflection_topic(bag: str | Path, topics: list[str], finger: str) -> str:
    found = [topic for topic in topics if topic.split("/")[-1] == "deflection"]
    if finger:
        found = [topic for topic in found if topic == f"/{finger.strip('/')}/deflection"]
    if len(found) != 1:
        which = "several topics" if found else f"no topic '{finger}/deflection'"
        raise BagError(f"{bag}: {which} of a finger; topics: {', '.join(topics)}")
    return found[0]


def _seconds(message: Any) -> float:
    return message.header.stamp.sec + message.header.stamp.nanosec * 1e-9


def _align(numbers: NDArray[np.int64], samples: list[Any]) -> NDArray[np.float64]:
    values = {m.number: m.value for m in samples}
    return np.array([values.get(number, np.nan) for number in numbers.tolist()])


def _signal(topics: dict[str, list[Any]], name: str, stamps: NDArray) -> NDArray[np.float64]:
    """Evaluate a signal that came as a profile or, without one, as set-points."""
    profiles = topics.get(f"{name}_profile", [])
    if profiles:
        last = profiles[-1]
        return Profile(last.time, last.value, last.interpolation == LINEAR).at(stamps - stamps[0])
    points = topics.get(name, [])
    return _held([_seconds(m) for m in points], [m.value for m in points], stamps)


def _held(instants: list[float], values: list[float], stamps: NDArray) -> NDArray[np.float64]:
    if not instants:
        return np.full(stamps.shape, np.nan)
    index = np.searchsorted(instants, stamps + 1e-9, side="right") - 1
    return np.where(index >= 0, np.array(values)[np.maximum(index, 0)], np.nan)
