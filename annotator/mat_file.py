"""A safe reader for MATLAB files, versions 5 to 7, even if they are damaged or untrusted.

scipy.io.loadmat crashes the process on some damaged files. This reader supports the types that labels and clouds use:
numbers, strings, structs and cells. Format: "MAT-File Format" (MathWorks), chapter "Level 5 MAT-Files". A header of 128
bytes is followed by elements: a type, a length and that many bytes. An array is an element that contains elements, with
its values in column order. A compressed element is a zlib stream of another element.
"""

from __future__ import annotations

import errno
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from annotator.files import read_file

HEAD_BYTES, TAG_BYTES = 128, 8
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
ENCODINGS = {1: "latin-1", 2: "latin-1", 4: "utf-16", 16: "utf-8", 17: "utf-16", 18: "utf-32"}
CELL, STRUCT, CHAR, NUMERIC = 1, 2, 4, range(6, 16)
# Depth of nested structs; SUN RGB-D's have two levels.
MOST_LEVELS = 8
MOST_DIMENSIONS = 8
# MATLAB's own limit for the elements of an array.
MOST_ELEMENTS = 2**48 - 1
# Limit for the elements of cells and structs in a file, each of which becomes a Python object. SUN RGB-D's table has
# about 700,000.
MOST_OBJECTS = 2**21
# The value of empty elements; shared, because a few bytes can declare millions of them.
EMPTY = np.zeros((0, 0))
EMPTY.flags.writeable = False


class MatFileError(ValueError):
    """Not a supported MATLAB file, or it does not contain the variable."""


class MatSizeError(MatFileError):
    """A variable that is larger than the limit."""


class _Element(NamedTuple):
    kind: int
    data: memoryview


def read_mat(path: Path, name: str, most_bytes: int, *, numbers_only: bool = False) -> object:
    """The variable `name` of a file: an array of numbers, a string, a list of a struct's or cell's elements, or None.

    None stands for other types, such as functions, and for strings of several lines.

    Args:
        most_bytes: size limit of the file, and of the uncompressed variable.
        numbers_only: refuse variables of other types without building any part of them.

    Raises:
        MatFileError: too large, damaged, of another version, more than `MOST_OBJECTS` elements of cells and structs, or
            no such variable.
        OSError: the file cannot be read.
    """
    try:
        data = read_file(path, most_bytes)
    except OSError as error:
        if error.errno == errno.EFBIG:
            raise MatSizeError(f"is larger than {most_bytes // 2**20} MiB") from error
        raise
    if len(data) < HEAD_BYTES or data[126:128] not in (b"IM", b"MI"):
        raise MatFileError("is not a MATLAB file of version 5 to 7; save it with -v7")
    reader = _Reader("<" if data[126:128] == b"IM" else ">", numbers_only)
    for element in reader.elements(memoryview(data)[HEAD_BYTES:]):
        if element.kind == COMPRESSED:
            element = next(reader.elements(_unpacked(element.data, most_bytes)), _Element(0, memoryview(b"")))
        if element.kind == MATRIX:
            title, value = reader.array(element.data, name)
            if title == name:
                return value
    raise MatFileError(f"has no variable {name}")


def _unpacked(data: memoryview, most_bytes: int) -> memoryview:
    """The content of a compressed element."""
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data, most_bytes + 1)
    except zlib.error as error:
        raise MatFileError(f"is damaged ({error})") from error
    if len(content) > most_bytes:
        raise MatSizeError(f"has more than {most_bytes // 2**20} MiB when unpacked")
    return memoryview(content)


@dataclass
class _Reader:
    """Reads the elements of one file.

    Attributes:
        order: byte order, "<" or ">".
        numbers_only: refuse strings, cells and structs.
        left: number of elements of cells and structs that may still be read.
    """

    order: str
    numbers_only: bool
    left: int = MOST_OBJECTS

    def elements(self, data: memoryview) -> Iterator[_Element]:
        """The consecutive elements in `data`."""
        at = 0
        while at < len(data):
            element, at = self._element(data, at)
            yield element

    def _element(self, data: memoryview, at: int) -> tuple[_Element, int]:
        """The element at an offset, and the offset after it."""
        if at + TAG_BYTES > len(data):
            raise MatFileError("is truncated")
        kind, length = struct.unpack_from(self.order + "II", data, at)
        if kind >> 16:
            # data of up to four bytes is stored in the tag itself
            kind, length, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + TAG_BYTES
            if length > 4:
                raise MatFileError("has a damaged element")
        else:
            start = at + TAG_BYTES
            # elements are padded to multiples of eight bytes, except compressed ones
            end = start + length + (-length % 8 if kind != COMPRESSED else 0)
        if start + length > len(data):
            raise MatFileError("is truncated")
        return _Element(kind, data[start : start + length]), min(end, len(data))

    def array(self, data: memoryview, only: str | None = None, level: int = 0) -> tuple[str, object]:
        """Name and value of an array; the value is None if `only` is given and differs from the name."""
        parts = self.elements(data)
        flags, sizes, name = (next(parts, None) for _ in range(3))
        if flags is None:
            return "", EMPTY
        if sizes is None or name is None or len(flags.data) < 4 or level > MOST_LEVELS:
            raise MatFileError("has a damaged array")
        title = bytes(name.data).decode("latin-1")
        if only is not None and title != only:
            return title, None
        kind = struct.unpack_from(self.order + "I", flags.data)[0] & 0xFF
        shape = tuple(self._integers(sizes))
        if any(not 0 <= size <= MOST_ELEMENTS for size in shape):
            raise MatFileError("has an array with an invalid size")
        if kind in NUMERIC:
            return title, self._numbers(next(parts, None), shape)
        if self.numbers_only:
            raise MatFileError(f"has values other than numbers in {title}")
        if kind == CHAR:
            return title, self._text(next(parts, None), shape)
        if kind == STRUCT:
            return title, self._records(parts, math.prod(shape), len(data), level)
        if kind == CELL:
            self._reserve(math.prod(shape), len(data))
            return title, [self._next_array(parts, level) for _ in range(math.prod(shape))]
        return title, None

    def _records(self, parts: Iterator[_Element], count: int, room: int, level: int) -> list[dict[str, object]]:
        """The elements of a struct array, each with its fields in order."""
        length, names = next(parts, None), next(parts, None)
        if length is None or names is None or not (widths := self._integers(length)) or widths[0] <= 0:
            raise MatFileError("has a damaged struct")
        packed = bytes(names.data)
        self._reserve(len(packed) // widths[0], len(packed) * TAG_BYTES)
        fields = [packed[i : i + widths[0]].partition(b"\0")[0] for i in range(0, len(packed), widths[0])]
        if not fields:
            return []
        # the elements themselves, then their fields
        self._reserve(count, room)
        self._reserve(count * len(fields), room)
        titles = [field.decode("latin-1") for field in fields]
        return [{title: self._next_array(parts, level) for title in titles} for _ in range(count)]

    def _next_array(self, parts: Iterator[_Element], level: int) -> object:
        element = next(parts, None)
        if element is None or element.kind != MATRIX:
            raise MatFileError("lacks elements of a struct or cell array")
        return self.array(element.data, None, level + 1)[1]

    def _reserve(self, count: int, room: int) -> None:
        """Checks that `room` bytes can hold `count` elements, each with a tag, and counts them against the limit."""
        if count * TAG_BYTES > room:
            raise MatFileError(f"declares {count} elements in {room} bytes")
        self.left -= count
        if self.left < 0:
            raise MatFileError(f"has more than {MOST_OBJECTS} elements of cells and structs")

    def _integers(self, element: _Element) -> list[int]:
        """The integers of an element with sizes or lengths."""
        values = self._values(element)
        if values.dtype.kind not in "iu" or len(values) > MOST_DIMENSIONS:
            raise MatFileError("has an array with an invalid size")
        return [int(value) for value in values]

    def _numbers(self, element: _Element | None, shape: tuple[int, ...]) -> np.ndarray:
        if element is None:
            raise MatFileError("lacks the values of an array")
        values = self._values(element)
        if len(values) != math.prod(shape):
            raise MatFileError(f"has {len(values)} values for an array of {' x '.join(map(str, shape))}")
        try:
            return values.reshape(shape, order="F")
        except ValueError as error:
            # an empty array, one dimension of which is too large
            raise MatFileError(f"has an array with an invalid size ({error})") from error

    def _values(self, element: _Element) -> np.ndarray:
        if element.kind not in NUMBERS:
            raise MatFileError("has values of an unknown type")
        dtype = np.dtype(self.order + NUMBERS[element.kind])
        if len(element.data) % dtype.itemsize:
            raise MatFileError("has truncated values")
        return np.frombuffer(element.data, dtype)

    def _text(self, element: _Element | None, shape: tuple[int, ...]) -> str | None:
        """A string of one line; None for several lines."""
        if element is None or element.kind not in ENCODINGS:
            raise MatFileError("lacks the characters of a text")
        if len(shape) != 2 or (shape[0] != 1 and math.prod(shape) > 0):
            return None
        encoding = ENCODINGS[element.kind]
        if encoding in ("utf-16", "utf-32"):
            encoding += "-le" if self.order == "<" else "-be"
        try:
            return bytes(element.data).decode(encoding)
        except UnicodeDecodeError as error:
            raise MatFileError(f"has a damaged text ({error.reason})") from error
