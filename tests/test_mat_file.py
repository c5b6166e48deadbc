"""MATLAB files: the same values as scipy reads and the format's own example; damage is an error, never a crash."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
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
def test_what_scipy_writes(tmp_path: Path, compressed: bool) -> None:
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
def test_bytes_by_hand(tmp_path: Path, order: str) -> None:
    """A 1 x 2 array `ab` of doubles, whose values 3 and 5 are kept as two bytes in a tag, in both byte orders."""
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


def written() -> bytes:
    stream = io.BytesIO()
    savemat(stream, {"table": structs()})
    return stream.getvalue()


CONTENT = written()
PLACES = st.integers(120, len(CONTENT) - 1)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(PLACES, st.binary(max_size=5), st.integers(0, 9)), min_size=1, max_size=4))
def test_damage_is_an_error_and_never_a_crash(tmp_path: Path, damages: list[tuple[int, bytes, int]]) -> None:
    """scipy's reader ends the program at many of these."""
    data = bytearray(CONTENT)
    for place, inserted, removed in damages:
        data[place : place + removed] = inserted
    (tmp_path / "a.mat").write_bytes(data)
    try:
        value = read_mat(tmp_path / "a.mat", "table", 2**20)
    except MatFileError:
        return
    assert value is None or isinstance(value, list | np.ndarray | str)


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        # the array's length, its rows, the length of field names: after head, tag and flags, with its size and name
        (132, 2**31 - 1, "is cut off"),
        (160, 2**30, "promises .* elements in"),
        (160, 2**32 - 1, "impossible size"),
    ],
)
def test_huge_counts_take_no_memory(tmp_path: Path, place: int, value: int, problem: str) -> None:
    data = bytearray(CONTENT)
    struct.pack_into("<I", data, place, value)
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(MatFileError, match=problem):
        read_mat(tmp_path / "a.mat", "table", 2**20)
