# SPDX-License-Identifier: Apache-2.0
"""MCAP files record by record, as far as they go (https://mcap.dev/spec).

Of its own, as a whole bag is read without the packages that this needs: mcap, lz4 and zstandard.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.well_known import SchemaEncoding

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


def read_records(
    path: Path,
    learn: Callable[[str, str, bool], None],
    add: Callable[[str, str, int, bytes], None],
) -> bool:
    """Read a file and say whether it is whole.

    `learn(type, definition, is_idl)` is told each message definition, `add(topic, type, stamp, data)` each
    message, up to the place where the file breaks. Whatever a damaged file leads to is raised.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    whole = False
    with path.open("rb") as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            raise McapError("it does not begin with MCAP's magic bytes")
        for opcode, content in _records(file):
            whole = opcode == Opcode.FOOTER
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                schemas[schema.id] = schema
                is_idl = schema.encoding == SchemaEncoding.ROS2IDL
                learn(schema.name, schema.data.decode(), is_idl)
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                channels[channel.id] = channel
            elif opcode == Opcode.MESSAGE:
                number, _, stamp, _ = MESSAGE.unpack_from(content)
                channel = channels[number]
                kind = schemas[channel.schema_id].name
                add(channel.topic, kind, stamp, content[MESSAGE.size :])
    return whole


def _records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
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
            yield from _records(BytesIO(DECOMPRESS[compression](content[begin + 8 :])))
        elif len(content) == length:
            yield opcode, content
