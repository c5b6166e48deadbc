"""The process for libraries that trust what they read: its crashes and limits are errors; and MATLAB files."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from annotator import fence
from annotator.fence import FenceError, fenced
from annotator.fenced_files import read_mat
from annotator.frame_limits import VARIABLE, frame_memory


def test_a_crash_and_too_much_memory_or_time_are_errors_and_the_next_file_is_read(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(FenceError, match="is damaged: its decoder crashed"):
        fenced("os:abort")
    with pytest.raises(FenceError, match=f"is too large: .*{VARIABLE} sets more"):
        fenced("builtins:bytes", 1 << 40)
    with pytest.raises(FenceError, match="is too large"):
        fenced("builtins:bytes", frame_memory())
    with pytest.raises(ValueError, match="invalid literal"):
        fenced("builtins:int", "x")
    with pytest.raises(FenceError, match="TypeError: object of type"):
        fenced("builtins:len", 3)
    assert fenced("builtins:len", b"abc") == 3
    monkeypatch.setattr(fence, "MOST_S", 0.1)
    with pytest.raises(FenceError, match="or did not end"):
        fenced("time:sleep", 60)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory so")
def test_its_memory_is_limited_also_where_the_shell_has_a_lower_limit() -> None:
    assert fenced("resource:getrlimit", 9) == (fence.LIBRARIES_BYTES + 2 * frame_memory(),) * 2
    code = "from annotator.fence import fenced; print(*fenced('resource:getrlimit', 9))"
    low = ["sh", "-c", 'ulimit -v 6000000; exec "$0" -c "$1"', sys.executable, code]
    assert subprocess.run(low, capture_output=True, check=True).stdout.split() == [b"%d" % (6_000_000 << 10)] * 2


CELLS = np.empty((1, 2), object)
CELLS[0, 0], CELLS[0, 1] = np.eye(2), "inside"


def structs() -> np.ndarray:
    table = np.empty((1, 2), [("number", object), ("text", object), ("cells", object)])
    table[0, 0] = (np.arange(6.0).reshape(2, 3), "Tür", CELLS)
    table[0, 1] = (np.array([[7]], np.int16), "", np.zeros((0, 0)))
    return table


@pytest.mark.parametrize("compressed", [False, True])
def test_matlab_files_are_read(tmp_path: Path, compressed: bool) -> None:
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
    with pytest.raises(FenceError, match="has no variable third"):
        read_mat(path, "third", 2**20)
    with pytest.raises(OSError, match="larger than"):
        read_mat(path, "cloud", 3000)
    content = path.read_bytes()
    for damaged, problem in (
        (content[:400], "cannot be decoded|damaged|Expecting"),
        (b"x" * 200, "is not a MATLAB file of version 5 to 7"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=problem):
            read_mat(path, "cloud", 2**20)


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


@pytest.mark.parametrize(("kind", "value"), [(6, element(9, bytes(2**26))), (1, element(14, b"") * 2**18)])
def test_a_small_matlab_file_takes_no_gigabytes(tmp_path: Path, kind: int, value: bytes) -> None:
    """One unpacks to many numbers, the other to many objects."""
    count = (len(value) - 8 * (kind == 6)) // 8
    head = element(6, struct.pack("<II", kind, 0)) + element(5, struct.pack("<ii", 1, count)) + element(1, b"ab")
    packed = zlib.compress(element(14, head + value))
    path = tmp_path / "a.mat"
    path.write_bytes(b"MATLAB 5.0".ljust(124) + b"\0\1IM" + struct.pack("<II", 15, len(packed)) + packed)
    assert path.stat().st_size < 2**17
    with pytest.raises(FenceError, match="its ab is larger than 32 MiB in memory"):
        read_mat(path, "ab", 2**25)
