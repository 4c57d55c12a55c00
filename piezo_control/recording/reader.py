# SPDX-License-Identifier: Apache-2.0
"""Messages of a rosbag2 recording, also of one that was cut off.

A finished bag is read by `rosbags`. A recorder that was killed leaves no `metadata.yaml`, and a full
disk or an interrupted copy ends a file in the middle; then the MCAP or SQLite file is read record by
record, up to the place where it breaks. MCAP: https://mcap.dev/spec; schema of the SQLite file:
https://github.com/ros2/rosbag2/tree/jazzy/rosbag2_storage_sqlite3.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.well_known import SchemaEncoding
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

MCAP_MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
CHUNK_COMPRESSION = 28  # offset of the length of a chunk's compression name
DECOMPRESS = {
    "": lambda data: data,
    "zstd": lambda data: zstandard.ZstdDecompressor().decompressobj().decompress(data),
    "lz4": lambda data: lz4.frame.LZ4FrameDecompressor().decompress(data),
}
"""Decompressors that give what they can of data that was cut off."""


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

    def messages(self, topic: str, kind: str) -> list[Any]:
        """Return the messages of `topic`, which have to be of type `kind`; none for no such topic.

        Raises BagError, naming topic and type, for another type or for data that do not fit it.
        """
        found = self.topics.get(topic, Topic(kind))
        if found.type != kind:
            raise BagError(f"{self.path}: topic '{topic}' is of type {found.type}, must be {kind}")
        try:
            return [self.typestore.deserialize_cdr(data, kind) for data in found.data]
        except (SerdeError, KeyError) as error:
            raise BagError(
                f"{self.path}: topic '{topic}' cannot be read as {kind}: {error}"
            ) from None

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
        except (AnyReaderError, ReaderError, OSError, struct.error, TypeError, ValueError) as error:
            damage = str(error)
    else:
        damage = "the recorder did not finish it: metadata.yaml is missing" if path.is_dir() else ""
    bag = Bag(path, get_typestore(Stores.ROS2_JAZZY), {}, damage)
    files = sorted(f for f in (path.iterdir() if path.is_dir() else [path]) if f.is_file())
    readers = {".mcap": _read_mcap, ".db3": _read_sqlite}
    storage = [f for f in files if f.suffix in readers]
    if not storage:
        raise BagError(f"{path}: no bag: no .mcap or .db3 file{f' ({damage})' if damage else ''}")
    for file in storage:
        if not readers[file.suffix](file, bag):
            bag.damage = bag.damage or f"{file.name} ends in the middle"
    return bag


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
    schemas: dict[int, Schema] = {}
    channels: dict[int, Topic] = {}
    whole = False
    with path.open("rb") as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise BagError(f"{path}: no MCAP file: it does not begin with MCAP's magic bytes")
        try:
            for opcode, content in _mcap_records(file):
                whole = opcode == Opcode.FOOTER
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(ReadDataStream(BytesIO(content)))
                    schemas[schema.id] = schema
                    is_idl = schema.encoding == SchemaEncoding.ROS2IDL
                    _learn(bag.typestore, schema.name, schema.data.decode(), is_idl)
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(ReadDataStream(BytesIO(content)))
                    kind = schemas[channel.schema_id].name
                    channels[channel.id] = bag.topics.setdefault(channel.topic, Topic(kind))
                elif opcode == Opcode.MESSAGE:
                    number, _, stamp, _ = MESSAGE.unpack_from(content)
                    channels[number].stamps.append(stamp)
                    channels[number].data.append(content[MESSAGE.size :])
        except (McapError, struct.error, KeyError, zstandard.ZstdError, RuntimeError) as error:
            bag.damage = f"{path.name} is damaged: {error!r}"
    return whole


def _mcap_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of all whole records, those inside of chunks as well."""
    while len(head := file.read(RECORD.size)) == RECORD.size:
        opcode, length = RECORD.unpack(head)
        content = file.read(length)
        if opcode == Opcode.CHUNK and len(content) > CHUNK_COMPRESSION + 4:
            (size,) = struct.unpack_from("<I", content, CHUNK_COMPRESSION)
            begin = CHUNK_COMPRESSION + 4 + size
            compression = content[CHUNK_COMPRESSION + 4 : begin].decode()
            if compression not in DECOMPRESS:
                raise McapError(f"unknown compression '{compression}'")
            yield from _mcap_records(BytesIO(DECOMPRESS[compression](content[begin + 8 :])))
        elif len(content) == length:
            yield opcode, content


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
    except sqlite3.Error as error:
        bag.damage = f"{path.name} is damaged: {error}"
        return False
    finally:
        database.close()
    return True
