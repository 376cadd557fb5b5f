"""Reading the sizes that Arrow files declare, before anything is inflated.

pyarrow inflates whatever a batch declares, and has no words for the headers of batches. These are tables of
FlatBuffers: at a table's beginning stands how far before it the places of its fields are listed.
"""

import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import pyarrow as pa
from pyarrow import ipc

# Of Footer, Message, DictionaryBatch and RecordBatch: the numbers of fields.
_DICTIONARIES, _BATCHES, _KIND, _HEADER, _DATA, _ROWS, _BUFFERS, _COMPRESSION = 2, 3, 1, 2, 1, 0, 2, 3
_IS_BATCH, _IS_DICTIONARY = 3, 2
_BLOCK, _BUFFER = struct.Struct("<qi4xq"), struct.Struct("<qq")
_END, _CONTINUES = b"ARROW1", b"\xff\xff\xff\xff"


class Declared(NamedTuple):
    """The columns and sizes that an Arrow file declares."""

    schema: pa.Schema
    rows: int
    inflated: int
    """Bytes in memory."""


def declared(stream: BinaryIO) -> Declared:
    """Looks at the footer and at the headers of all batches.

    Raises:
        ArrowException, OSError, ValueError: The file is damaged.
    """
    schema = ipc.open_file(stream).schema.remove_metadata()
    end = stream.seek(-4 - len(_END), 2)
    (length,) = struct.unpack("<i", stream.read(4))
    stream.seek(end - length)
    footer = _Table.of(stream.read(length))
    rows, size = 0, 0
    for field in (_DICTIONARIES, _BATCHES):
        for offset, _, stored in footer.vector(field, _BLOCK):
            batch, body = _batch_at(stream, offset)
            rows += batch.number(_ROWS, "<q") if field == _BATCHES else 0
            # Before each compressed buffer stands its length.
            places = batch.vector(_BUFFERS, _BUFFER) if batch.place(_COMPRESSION) else ()
            size += stored + sum(_inflated(stream, body + place) for place, length in places if length)
    return Declared(schema, rows, size)


def whole_batch(reader: ipc.RecordBatchFileReader, number: int) -> pa.RecordBatch:
    """Reads a batch of an Arrow file, whose offsets and indices Arrow itself takes as they are.

    Raises:
        ArrowException: It is damaged.
    """
    batch = reader.get_batch(number)
    batch.validate(full=True)
    return batch


class _Table(NamedTuple):
    """A table of FlatBuffers."""

    content: bytes
    at: int

    @classmethod
    def of(cls, content: bytes) -> "_Table":
        """The table at the root."""
        return cls(content, _number(content, 0, "<I"))

    def place(self, field: int) -> int:
        """Where a field is; 0 where it is left out."""
        fields = self.at - _number(self.content, self.at, "<i")
        there = 4 + 2 * field < _number(self.content, fields, "<H")
        offset = _number(self.content, fields + 4 + 2 * field, "<H") if there else 0
        return self.at + offset if offset else 0

    def number(self, field: int, kind: str) -> int:
        """A number, 0 where it is left out."""
        place = self.place(field)
        return _number(self.content, place, kind) if place else 0

    def table(self, field: int) -> "_Table":
        """Another table."""
        place = self.place(field)
        return _Table(self.content, place + _number(self.content, place, "<I"))

    def vector(self, field: int, kind: struct.Struct) -> Iterator[tuple[int, ...]]:
        """Entries of one length."""
        place = self.place(field)
        if not place:
            return iter(())
        start = place + _number(self.content, place, "<I")
        count = _number(self.content, start, "<I")
        entries = self.content[start + 4 : start + 4 + count * kind.size]
        if len(entries) != count * kind.size:
            raise ValueError("a list that is longer than its header")
        return kind.iter_unpack(entries)


def _number(content: bytes, place: int, kind: str) -> int:
    try:
        return struct.unpack(kind, content[max(place, 0) : max(place, 0) + struct.calcsize(kind)])[0]
    except struct.error as error:
        raise ValueError("a header that ends early") from error


def _batch_at(stream: BinaryIO, offset: int) -> tuple[_Table, int]:
    """The header of a batch, and where its body is."""
    stream.seek(max(offset, 0))
    start = stream.read(8)
    # Files of old have no mark before the length.
    before = 8 if start[:4] == _CONTINUES else 4
    length = _number(start, before - 4, "<i")
    stream.seek(max(offset, 0) + before)
    message = _Table.of(stream.read(max(length, 0)))
    kind, header = message.number(_KIND, "<B"), message.table(_HEADER)
    if kind not in (_IS_BATCH, _IS_DICTIONARY):
        raise ValueError("a header that is none of a batch")
    return header.table(_DATA) if kind == _IS_DICTIONARY else header, max(offset, 0) + before + max(length, 0)


def _inflated(stream: BinaryIO, place: int) -> int:
    stream.seek(max(place, 0))
    # -1 where it is stored as it is.
    return max(0, _number(stream.read(8), 0, "<q"))
