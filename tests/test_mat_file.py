"""MATLAB files: the same values as scipy, and the format's example; damage is an error, never a crash."""

from __future__ import annotations

import io
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from annotator.mat_file import MatFileError, read_mat

FIELDS = [("number", object), ("text", object), ("cells", object)]
CELLS = np.empty((1, 2), object)
CELLS[0, 0], CELLS[0, 1] = np.eye(2), "inside"


def structs() -> np.ndarray:
    table = np.empty((1, 2), FIELDS)
    table[0, 0] = (np.arange(6.0).reshape(2, 3), "Tür", CELLS)
    table[0, 1] = (np.array([[7]], np.int16), "", np.zeros((0, 0)))
    return table


@pytest.mark.parametrize("compressed", [False, True])
def test_files_written_by_scipy_are_read(tmp_path: Path, compressed: bool) -> None:
    path, cloud = tmp_path / "a.mat", np.random.default_rng(0).normal(size=(500, 6)).astype(np.float32)
    savemat(path, {"first": np.ones(3, np.uint8), "cloud": cloud, "table": structs()}, do_compression=compressed)
    np.testing.assert_array_equal(read_mat(path, "cloud", 2**20), loadmat(path)["cloud"])
    np.testing.assert_array_equal(read_mat(path, "first", 2**20), [[1, 1, 1]])
    first, second = read_mat(path, "table", 2**20)  # type: ignore[misc]
    np.testing.assert_array_equal(first["number"], [[0, 1, 2], [3, 4, 5]])
    assert first["text"] == "Tür"
    np.testing.assert_array_equal(first["cells"][0], np.eye(2))
    assert first["cells"][1] == "inside"
    assert (second["number"].tolist(), second["text"], second["cells"].size) == ([[7]], "", 0)
    with pytest.raises(MatFileError, match="has no variable third"):
        read_mat(path, "third", 2**20)
    with pytest.raises(MatFileError, match="is larger than 0 MiB"):
        read_mat(path, "cloud", 3000)


@pytest.mark.parametrize("order", "<>")
def test_bytes_written_by_hand_are_read_in_both_byte_orders(tmp_path: Path, order: str) -> None:
    """A 1 x 2 array `ab` of doubles, whose values 3 and 5 are stored as two bytes in a small data element."""
    flags = struct.pack(order + "IIII", 6, 8, 6, 0)
    sizes = struct.pack(order + "IIii", 5, 8, 1, 2)
    name = struct.pack(order + "I", 2 << 16 | 1) + b"ab\0\0"
    values = struct.pack(order + "I", 2 << 16 | 2) + b"\3\5\0\0"
    array = flags + sizes + name + values
    mark = b"IM" if order == "<" else b"MI"
    content = b"MATLAB 5.0".ljust(124) + b"\0\1" + mark + struct.pack(order + "II", 14, len(array)) + array
    (tmp_path / "a.mat").write_bytes(content)
    value = read_mat(tmp_path / "a.mat", "ab", 2**20)
    assert isinstance(value, np.ndarray)
    assert value.tolist() == [[3, 5]]


def array(kind: int, sizes: bytes, *content: bytes, sizes_type: int = 5) -> bytes:
    """An array `ab` as an element of a file."""
    flags, name = element(6, struct.pack("<II", kind, 0)), element(1, b"ab")
    return element(14, flags + element(sizes_type, sizes) + name + b"".join(content))


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data.ljust(-(-len(data) // 8) * 8, b"\0")


def write_mat(path: Path, content: bytes) -> Path:
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\0\1IM" + element(15, zlib.compress(content)))
    return path


@pytest.mark.parametrize(
    ("sizes", "sizes_type"),
    [
        (struct.pack("<dd", np.inf, 0), 9),
        (struct.pack("<dd", np.nan, 0), 9),
        (struct.pack("<QQQ", 0, 2**62, 2**62), 13),
        (struct.pack("<QQ", 0, 2**64 - 1), 13),
        # each size is valid, their product is not
        (struct.pack("<QQQ", 0, 2**40, 2**40), 13),
        (struct.pack("<9i", *[1] * 9), 5),
    ],
)
def test_invalid_array_sizes_are_errors(tmp_path: Path, sizes: bytes, sizes_type: int) -> None:
    path = write_mat(tmp_path / "a.mat", array(6, sizes, element(9, b""), sizes_type=sizes_type))
    with pytest.raises(MatFileError, match="has an array with an invalid size"):
        read_mat(path, "ab", 2**20)


def many(promised: str) -> bytes:
    """Four million empty cells, elements of a struct of one field, or fields of an empty struct."""
    number, one_letter, nothing = 2**22, element(5, b"\1\0\0\0"), element(14, b"")
    sizes = struct.pack("<ii", 1, number)
    if promised == "cells":
        return array(1, sizes, nothing * number)
    if promised == "elements":
        return array(2, sizes, one_letter, element(1, b"a"), nothing * number)
    return array(2, struct.pack("<ii", 0, 0), one_letter, element(1, b"a" * number))


@pytest.mark.parametrize("promised", ["cells", "elements", "fields"])
def test_a_small_file_cannot_create_millions_of_objects(tmp_path: Path, promised: str) -> None:
    path = write_mat(tmp_path / "a.mat", many(promised))
    assert path.stat().st_size < 2**16
    tracemalloc.start()
    with pytest.raises(MatFileError, match="has more than 2097152 elements of cells and structs"):
        read_mat(path, "ab", 2**26)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # they unpack to 32 MiB, for which zlib needs up to twice as much; objects would need several times that
    assert peak < 100 * 2**20


def test_numbers_only_refuses_other_values(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"cells": CELLS, "text": "inside", "number": np.eye(2)})
    for name in ("cells", "text"):
        with pytest.raises(MatFileError, match=f"has values other than numbers in {name}"):
            read_mat(tmp_path / "a.mat", name, 2**20, numbers_only=True)
    np.testing.assert_array_equal(read_mat(tmp_path / "a.mat", "number", 2**20, numbers_only=True), np.eye(2))


def written() -> bytes:
    stream = io.BytesIO()
    savemat(stream, {"table": structs()})
    return stream.getvalue()


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        # the array's length; its number of rows
        (132, 2**31 - 1, "is truncated"),
        (160, 2**30, "declares .* elements in"),
        (160, 2**32 - 1, "invalid size"),
    ],
)
def test_huge_counts_are_errors_without_allocating_memory(tmp_path: Path, place: int, value: int, problem: str) -> None:
    data = bytearray(written())
    struct.pack_into("<I", data, place, value)
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(MatFileError, match=problem):
        read_mat(tmp_path / "a.mat", "table", 2**20)
