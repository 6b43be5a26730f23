"""Reads the MCAP files of flights (mcap.dev/spec, uncompressed chunks), and their protobuf messages.

A truncated file, for example of a killed flight, is read up to its end. Every length is checked before use, so invalid
records are skipped and nothing is read outside the file.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

MAGIC = b"\x89MCAP0\r\n"
CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 0x04, 0x05, 0x06, 0x0C, 0x0F


class DamagedMessageError(ValueError):
    """A message of a log is invalid."""


class Place(NamedTuple):
    """Position of a message in the file."""

    log_time_ns: int
    start: int
    stop: int


class McapFile:
    """The messages of a file by topic, in the order of writing."""

    def __init__(self, path: Path):
        with path.open("rb") as file:
            try:
                self._bytes = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except ValueError:
                raise ValueError(f"{path} is empty: not a flight log") from None
        if self._bytes[:8] != MAGIC:
            raise ValueError(f"{path} is not an MCAP file; give a flight's log, such as flights/DATE.mcap")
        self.messages: dict[str, list[Place]] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.is_cut = False
        self._topics: dict[int, str] = {}
        try:
            self._index(8, len(self._bytes))
        except (struct.error, IndexError, UnicodeDecodeError):
            self.is_cut = True

    def data(self, place: Place) -> bytes:
        """Returns a message's bytes."""
        return self._bytes[place.start : place.stop]

    def _index(self, at: int, end: int) -> None:
        """Indexes the records from `at` to `end`, the end of a chunk or of the file."""
        data = self._bytes
        while at < end:
            if at + 9 > end:
                # The file ends with the magic bytes.
                self.is_cut = self.is_cut or end != len(data) or data[at:end] != MAGIC
                return
            opcode, length = struct.unpack_from("<BQ", data, at)
            at += 9
            if length > end - at:
                self.is_cut = True
                if opcode != CHUNK:
                    return
                # A truncated chunk: its messages up to here are complete.
                length = end - at
            if opcode == MESSAGE and length >= 22:
                channel, _, log_time_ns = struct.unpack_from("<HIQ", data, at)
                topic = self._topics.get(channel)
                if topic is not None:
                    self.messages.setdefault(topic, []).append(Place(log_time_ns, at + 22, at + length))
            elif opcode == CHUNK:
                _, _, _, _, name = struct.unpack_from("<QQQII", data, at)
                start = at + 32 + name + 8
                if name != 0 or start > at + length:
                    raise IndexError("a chunk is compressed or truncated")
                (size,) = struct.unpack_from("<Q", data, start - 8)
                self._index(start, min(start + size, at + length))
            elif opcode == CHANNEL:
                number, _ = struct.unpack_from("<HH", data, at)
                self._topics[number], _ = self._text(at + 4, at + length)
            elif opcode == METADATA:
                name_text, rest = self._text(at, at + length)
                self.metadata[name_text] = self._map(rest, at + length)
            elif opcode == DATA_END:
                return
            at += length

    def _text(self, at: int, end: int) -> tuple[str, int]:
        (length,) = struct.unpack_from("<I", self._bytes, at)
        stop = at + 4 + length
        if stop > end:
            raise IndexError("a text is truncated")
        return self._bytes[at + 4 : stop].decode(), stop

    def _map(self, at: int, end: int) -> dict[str, str]:
        (length,) = struct.unpack_from("<I", self._bytes, at)
        at, stop = at + 4, min(at + 4 + length, end)
        found = {}
        while at < stop:
            key, at = self._text(at, stop)
            found[key], at = self._text(at, stop)
        return found


def fields(message: bytes) -> dict[int, list[Any]]:
    """Returns the fields of a protobuf message by number: varints as integers, all others as bytes.

    Raises DamagedMessageError for an invalid message.
    """
    found: dict[int, list[Any]] = {}
    for number, value in _fields(message):
        found.setdefault(number, []).append(value)
    return found


def _fields(message: bytes) -> Iterator[tuple[int, Any]]:
    at = 0
    while at < len(message):
        key, at = _varint(message, at)
        kind = key & 7
        if kind == 0:
            value: Any
            value, at = _varint(message, at)
        else:
            if kind == 2:
                length, at = _varint(message, at)
            elif kind in (1, 5):
                length = 8 if kind == 1 else 4
            else:
                raise DamagedMessageError(f"a protobuf field has the unknown type {kind}")
            if length > len(message) - at:
                raise DamagedMessageError("a protobuf message is truncated")
            value, at = message[at : at + length], at + length
        yield key >> 3, value


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            break
        byte = message[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise DamagedMessageError("a protobuf number is truncated")
