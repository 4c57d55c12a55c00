# SPDX-License-Identifier: Apache-2.0
"""Writes rosbag2 folders (MCAP) with message definitions: for the recorder node and for the engine."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from piezo_control.files import why_not
from piezo_control.profile import Profile
from piezo_control.recording.reader import BagError, open_bag
from piezo_control.recording.recording import (
    LINEAR,
    PROFILE_TYPE,
    SAMPLE_TYPE,
    TEMPERATURE_TYPE,
    Recording,
)
from piezo_control.shared import shared_folder

# Encapsulation, stamp, empty frame_id, number, value, period, and the three that are true or false.
SAMPLE_CDR = struct.Struct("<4s i I I 4x Q d d ? ? ?")
LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def sample_data(
    stamp: int,
    number: int,
    value: float,
    period: float,
    limited: bool = False,
    by_controller: bool = False,
    without_temperature: bool = False,
) -> bytes:
    """Return a serialized Sample with its time `stamp` in ns."""
    flags = limited, by_controller, without_temperature
    seconds, nanoseconds = divmod(stamp, 10**9)
    return SAMPLE_CDR.pack(LITTLE_ENDIAN, seconds, nanoseconds, 1, number, value, period, *flags)


class BagWriter:
    """A rosbag2 folder being written; it is readable after :meth:`close`.

    Raises ValueError when the folder exists or cannot be made.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if os.path.exists(path):  # Path.exists raises OSError for a name that no file can have
            raise ValueError(f"'bag' is '{path}', which exists; name a new folder")
        if reason := why_not(str(path), is_folder=True):
            raise ValueError(f"'bag' is {str(path)!r}: it {reason}")
        self.typestore = get_typestore(Stores.ROS2_JAZZY)
        self.learn("piezo_gripper_msgs", shared_folder() / "msg_defs")
        self._writer = Writer(self.path, version=9, storage_plugin=StoragePlugin.MCAP)
        try:
            self._writer.open()
        except OSError as error:
            raise ValueError(f"'bag' is '{path}', which cannot be written: {error}") from None

    def add(self, topic: str, kind: str, latched: bool = False) -> Connection:
        """Add a topic of message type `kind`; players offer a `latched` one to late subscribers too."""
        return self._writer.add_connection(
            topic, kind, typestore=self.typestore, offered_qos_profiles=[_offered(latched)]
        )

    def learn(self, package: str, folder: Path) -> None:
        """Register the messages of `package`, whose definitions are in `folder`/msg."""
        types = {}
        for path in (folder / "msg").glob("*.msg"):
            types.update(get_types_from_msg(path.read_text(), f"{package}/msg/{path.stem}"))
        self.typestore.register(types)

    def write(self, connection: Connection, stamp: int, data: bytes) -> None:
        """Write one serialized message with the bag's time stamp (ns)."""
        self._writer.write(connection, stamp, data)

    def flush(self) -> None:
        """Give what was written to the disk, so that it outlives this process.

        Raises OSError when the disk does not take it.
        """
        storage: Any = self._writer.storage  # rosbags' own MCAP writer; other kinds have no chunks
        if storage.chunk.msgs:
            storage.close_chunk()
        storage.bio.flush()

    def close(self) -> None:
        """Finish the folder."""
        self._writer.close()

    def has_header(self, kind: str) -> bool:
        """Say whether messages of type `kind` begin with a std_msgs/Header."""
        fields = self.typestore.fielddefs[kind][1]
        return bool(fields) and fields[0][1][1] == "std_msgs/msg/Header"


def recover(path: Path, to: Path) -> str:
    """Write what can be read of the bag at `path` as a whole bag; say what was in it.

    Raises BagError for what is no bag at all or one of which nothing can be read, ValueError
    when `to` exists.
    """
    found = open_bag(path)
    if not any(topic.data for topic in found.topics.values()):
        raise BagError(
            f"{path}: no message can be read of it{f' ({found.damage})' if found.damage else ''}"
        )
    bag = BagWriter(to)
    bag.typestore = found.typestore
    messages = []
    for name, topic in found.topics.items():
        connection = bag.add(name, topic.type, latched=topic.type == PROFILE_TYPE)
        messages += [(stamp, connection, data) for stamp, data in zip(topic.stamps, topic.data)]
    messages.sort(key=lambda message: message[0])
    for stamp, connection, data in messages:
        bag.write(connection, stamp, data)
    bag.close()
    condition = f"was cut ({found.damage})" if found.damage else "was whole"
    return f"{path} {condition}: {found.content()}"


def write_recording(
    path: str | Path, finger: str, recording: Recording, reference: Profile, tip_force: Profile
) -> None:
    """Write a run as the recorder node would have: topics of `finger`, stamps in simulated time.

    Temperatures are written where they change, reference and tip force as their profiles.
    """
    bag = BagWriter(path)
    for name, profile in (("reference", reference), ("tip_force", tip_force)):
        topic = bag.add(f"/{finger}/{name}_profile", PROFILE_TYPE, latched=True)
        bag.write(topic, 0, _profile(bag, profile))
    period = float(recording.time[1] - recording.time[0]) if recording.time.size > 1 else 0.0
    stamps = np.rint(recording.time * 1e9).astype(int).tolist()
    unlimited = [False] * len(stamps)
    signals = [
        (bag.add(f"/{finger}/{name}", SAMPLE_TYPE), getattr(recording, name).tolist(), limited)
        for name, limited in (
            ("deflection", unlimited),
            ("command", unlimited),
            ("voltage", (recording.limited == 1.0).tolist()),
        )
    ]
    warmth = bag.add(f"/{finger}/temperature", TEMPERATURE_TYPE)
    changes = set(np.flatnonzero(np.diff(recording.temperature, prepend=np.nan)).tolist())
    for k, (number, stamp) in enumerate(zip(recording.number.tolist(), stamps)):
        if k in changes:
            bag.write(warmth, stamp, _temperature(bag, stamp, recording.temperature[k]))
        for topic, values, limited in signals:
            bag.write(topic, stamp, sample_data(stamp, number, values[k], period, limited[k]))
    bag.close()


def _profile(bag: BagWriter, profile: Profile) -> bytes:
    message = bag.typestore.types[PROFILE_TYPE](
        _header(bag, 0), LINEAR if profile.linear else 0, profile.time, profile.value, max_force=0.0
    )
    return bytes(bag.typestore.serialize_cdr(message, PROFILE_TYPE))


def _temperature(bag: BagWriter, stamp: int, degc: float) -> bytes:
    message = bag.typestore.types[TEMPERATURE_TYPE](_header(bag, stamp), degc, 0.0)
    return bytes(bag.typestore.serialize_cdr(message, TEMPERATURE_TYPE))


def _header(bag: BagWriter, stamp: int) -> object:
    types = bag.typestore.types
    return types["std_msgs/msg/Header"](
        types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), ""
    )


def _offered(latched: bool) -> Qos:
    """Return the quality of service that players offer: reliable, and every sample or the newest."""
    forever = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST if latched else QosHistory.KEEP_ALL,
        1 if latched else 0,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        forever,
        forever,
        QosLiveliness.AUTOMATIC,
        forever,
        False,
    )
