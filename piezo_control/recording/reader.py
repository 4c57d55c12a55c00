# SPDX-License-Identifier: Apache-2.0
"""Messages of a rosbag2 recording, also of one that was cut off.

A finished bag is read by `rosbags`. A recorder that was killed leaves no `metadata.yaml`, and a full
disk or an interrupted copy ends a file in the middle; then the MCAP or SQLite file is read record by
record, up to the place where it breaks. Schema of the SQLite file:
https://github.com/ros2/rosbag2/tree/jazzy/rosbag2_storage_sqlite3.
"""

from __future__ import annotations

import re
import sqlite3
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


class BagError(ValueError):
    """A bag that cannot be read as a finger's run; the message names bag, topic and what was found."""


@dataclass
class Topic:
    """One topic: message type, and per message the bag's time stamp (ns) and the serialized data."""

    type: str
    stamps: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)


@dataclass
class Bag:
    """What a recording holds; `damage` says what is wrong with it and is empty for a whole one."""

    path: Path
    typestore: Typestore
    topics: dict[str, Topic]
    damage: str = ""
    _messages: dict[str, list[Any]] = field(default_factory=dict, init=False, repr=False)

    def messages(self, topic: str, kind: str) -> list[Any]:
        """Return the messages of `topic`, which have to be of type `kind`; none for no such topic.

        Raises BagError, naming topic and type, for another type or for data that do not fit it.
        """
        found = self.topics.get(topic, Topic(kind))
        if found.type != kind:
            raise BagError(f"{self.path}: topic '{topic}' is of type {found.type}, must be {kind}")
        if topic in self._messages:
            return self._messages[topic]
        try:
            messages = [self.typestore.deserialize_cdr(data, kind) for data in found.data]
        except Exception as error:  # of the library that takes the bytes apart, whatever they are
            raise BagError(
                f"{self.path}: topic '{topic}' cannot be read as {kind}: {error}"
            ) from None
        self._messages[topic] = messages  # taking the bytes apart costs more than all else
        return messages

    def content(self) -> str:
        """Return topics with their numbers of messages and types, for people."""
        return (
            ", ".join(f"{n} ({len(t.data)} {t.type})" for n, t in self.topics.items()) or "nothing"
        )


def open_bag(path: str | Path) -> Bag:
    """Read a rosbag2 folder, or one storage file of such a folder; deserializing comes later.

    A damaged recording is read as far as it goes and says so in `damage`. Raises BagError for what is
    no recording at all.
    """
    path = Path(path)
    if not path.exists():
        raise BagError(f"{path}: no such bag")
    if path.is_dir() and (path / "metadata.yaml").exists():
        try:
            return _whole(path)
        except Exception as error:  # of the reader's library: damage leads it to any kind of error
            damage = f"damaged: {error}" if str(error) else f"damaged ({type(error).__name__})"
    else:
        damage = "the recorder did not finish it: metadata.yaml is missing" if path.is_dir() else ""
    bag = Bag(path, get_typestore(Stores.ROS2_JAZZY), {}, damage)
    files = [f for f in (path.iterdir() if path.is_dir() else [path]) if f.is_file()]
    readers = {".mcap": _read_mcap, ".db3": _read_sqlite}
    storage = sorted((f for f in files if f.suffix in readers), key=_in_turn)
    if not storage:
        raise BagError(f"{path}: no bag: no .mcap or .db3 file{f' ({damage})' if damage else ''}")
    for file in storage:
        if not readers[file.suffix](file, bag):
            bag.damage = bag.damage or f"{file.name} ends in the middle"
    return bag


def _in_turn(path: Path) -> list[str | int]:
    """Return what sorts the files of a split bag by their numbers: the tenth after the second."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


def _whole(path: Path) -> Bag:
    default = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([path], default_typestore=default) as reader:
        topics = {c.topic: Topic(c.msgtype) for c in reader.connections}
        for connection, stamp, data in reader.messages():
            topic = topics[connection.topic]
            topic.stamps.append(stamp)
            topic.data.append(bytes(data))
        return Bag(path, reader.typestore, topics)


def _learn(typestore: Typestore, name: str, text: str, is_idl: bool) -> None:
    known = get_types_from_idl(text) if is_idl else get_types_from_msg(text, name)
    typestore.register({n: t for n, t in known.items() if n not in typestore.fielddefs})


def _read_mcap(path: Path, bag: Bag) -> bool:
    """Add the messages of an MCAP file and say whether it is whole."""
    try:
        from piezo_control.recording.mcap_records import read_records
    except ImportError as error:
        raise BagError(
            f"{path}: not read as a whole bag; for the rest, install {error.name}"
        ) from None

    def learn(kind: str, definition: str, is_idl: bool) -> None:
        _learn(bag.typestore, kind, definition, is_idl)

    def add(name: str, kind: str, stamp: int, data: bytes) -> None:
        topic = bag.topics.setdefault(name, Topic(kind))
        topic.stamps.append(stamp)
        topic.data.append(data)

    try:
        return read_records(path, learn, add)
    except (
        Exception
    ) as error:  # of what takes the records apart: damage leads it to any kind of error
        bag.damage = f"{path.name} is damaged: {error!r}"
        return False


def _read_sqlite(path: Path, bag: Bag) -> bool:
    """Add the messages of a SQLite file and say whether it is whole."""
    database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
    try:
        definitions = (
            "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        )
        for kind, encoding, text in database.execute(definitions):
            _learn(bag.typestore, kind, text, encoding == "ros2idl")
        kinds = {
            number: (n, t) for number, n, t in database.execute("SELECT id, name, type FROM topics")
        }
        for number, stamp, data in database.execute(
            "SELECT topic_id, timestamp, data FROM messages"
        ):
            name, kind = kinds[number]
            topic = bag.topics.setdefault(name, Topic(kind))
            topic.stamps.append(stamp)
            topic.data.append(data)
    except Exception as error:  # of the database or of what its definitions say
        bag.damage = f"{path.name} is damaged: {error}"
        return False
    finally:
        database.close()
    return True
