"""The door to files: bounded and regular ones are read, writing is whole or not at all; the fence for decoders."""

from __future__ import annotations

import errno
import os
import re
import resource
import stat
import struct
import subprocess
import sys
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import feather
from rgbd_samples import write_rgbd
from scipy.io import loadmat, savemat

from annotator import fence, files
from annotator.fence import FenceError, fenced
from annotator.fenced_files import read_feather, read_mat
from annotator.files import (
    MOST_DIRECTORY_BYTES,
    check_file,
    end_of_file,
    new_folder,
    open_archive,
    open_file,
    read_file,
    read_text_file,
    write_atomic,
)
from annotator.frame_limits import VARIABLE, frame_memory, require_pixels
from annotator.recordings import open_recording
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.sunrgbd import _read_mat
from annotator.types.errors import ConfigError, FormatError, FrameError


def test_a_file_is_replaced_completely_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    write_atomic(path, b"old")
    write_atomic(path, b"new")
    assert path.read_bytes() == b"new"
    (tmp_path / "plain").write_bytes(b"")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(files.os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_atomic(path, b"newer")
    assert path.read_bytes() == b"new"
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["a.json", "plain"]


def test_a_folder_is_replaced_completely_or_not_at_all(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "out"
    with new_folder(out, lambda _: False) as part:
        (part / "a").touch()
        assert not out.exists()
    with pytest.raises(FormatError, match="exists and is not empty"), new_folder(out, lambda _: False):
        pytest.fail("the folder was replaced")
    with pytest.raises(ValueError, match="half"), new_folder(out, lambda _: True) as part:
        (part / "b").touch()
        raise ValueError("half")
    assert [entry.name for entry in out.iterdir()] == ["a"]
    with new_folder(out, lambda _: True) as part:
        (part / "c").touch()
    assert [entry.name for entry in out.iterdir()] == ["c"]
    assert [entry.name for entry in out.parent.iterdir()] == ["out"]


def test_what_a_killed_process_left_is_put_right(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out = tmp_path / "out[1]"
    # killed between the two renames: the new folder is complete, the old one moved aside
    for name, content in (
        (".out[1].old-abcdefgh", "old"),
        (".out[1].01234567.unfinished", "new"),
        (".out[1].old-_______0", ""),
    ):
        (tmp_path / name).mkdir()
        if content:
            (tmp_path / name / content).touch()
    others = (".out[1].part-mine", ".out[1].v2.01234567.unfinished", ".out1.01234567.unfinished", ".other.old-01234567")
    for name in others:
        (tmp_path / name).mkdir()
    with pytest.raises(FormatError, match="exists and is not empty"), new_folder(out, lambda _: False):
        pytest.fail("the old dataset was lost")
    assert [entry.name for entry in out.iterdir()] == ["old"]
    assert {entry.name for entry in tmp_path.iterdir()} == {"out[1]", *others}
    assert "put back from .out[1].old-abcdefgh" in caplog.text
    # killed after both renames
    (tmp_path / ".out[1].old-abcdefgh").mkdir()
    with new_folder(out, lambda _: True) as part:
        (part / "newer").touch()
        # a second process, before the first one has finished: nothing of it is touched
        with pytest.raises(FormatError), new_folder(out, lambda _: False):
            pytest.fail("the folder was replaced")
        assert (part / "newer").exists()
    assert [entry.name for entry in out.iterdir()] == ["newer"]
    assert {entry.name for entry in tmp_path.iterdir()} == {"out[1]", *others}


def test_a_folder_that_vanishes_before_it_is_locked_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, removed = files.lock_folder, list[Path]()

    def late(folder: Path, *, waits: bool = False) -> files.FolderLock:
        if not removed:
            removed.append(folder)
            folder.rmdir()
        return lock(folder, waits=waits)

    monkeypatch.setattr(files, "lock_folder", late)
    with new_folder(tmp_path / "out", lambda _: False) as part:
        (part / "a").touch()
    assert (tmp_path / "out" / "a").exists()
    assert part != removed[0]


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o755), (0o077, 0o700), (0o002, 0o775)])
def test_a_new_folder_follows_the_umask(tmp_path: Path, mask: int, mode: int) -> None:
    before = os.umask(mask)
    try:
        with new_folder(tmp_path / "out", lambda path: False) as part:
            (part / "file").write_text("x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == mode
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["file"]


PACKAGE = Path(__file__).resolve().parent.parent / "annotator"
# What opens a file by its path, to read it.
OPENERS = re.compile(
    r"\b(os\.open|np\.(load|fromfile|loadtxt|genfromtxt|memmap)|cv2\.(imread|VideoCapture)|json\.load|is_zipfile"
    r"|sqlite3\.connect|av\.open|laspy\.(open|read)|tarfile\.open|Image\.open"
    r"|read_table|loadmat|torch\.load)\((?!io\.BytesIO)|\.read_(bytes|text)\(|\.open\((\"rb?\"|encoding)"
)
# Modules that open what they have checked, or made themselves, and why.
EXCEPT = {
    "files.py": "it is the door",
    "project/database/store.py": "SQLite; the path is checked to be a regular file",
    "recordings/clouds/columns.py": "lines of a text that the door has read",
    "cli/main.py": "os.devnull",
    "formats/rcv.py": "the example in a dataset's README",
    "project/backup/archive.py": "a backup's file is opened through the door; SQLite, on a copy of our own",
    "project/backup/snapshot.py": "SQLite, and copies: regular files only, and no links",
    "project/database/migrations.py": "SQLite, in memory",
    "web/security.py": "the token may come from a pipe",
}


def test_files_are_read_through_one_door():
    texts = {path.relative_to(PACKAGE).as_posix(): path.read_text() for path in PACKAGE.rglob("*.py")}
    found = [
        place
        for place, text in texts.items()
        if place not in EXCEPT and OPENERS.search(text) and "check_file(" not in text
    ]
    assert found == [], "use annotator.files, or call check_file before a library opens a path"


READERS: list[Callable[[Path], object]] = [
    open_file,
    read_file,
    read_text_file,
    check_file,
    lambda path: end_of_file(path, 10),
]


@pytest.mark.parametrize("read", READERS)
def test_only_regular_files_are_opened(tmp_path: Path, read: Callable[[Path], object]):
    """A pipe would wait for its other end for ever, and a device has no end."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "device").symlink_to("/dev/zero")
    for name in ("pipe", "device"):
        with pytest.raises(OSError, match="not a regular file") as caught:
            read(tmp_path / name)
        assert caught.value.filename == str(tmp_path / name)
    with pytest.raises(IsADirectoryError):
        read(tmp_path)
    with pytest.raises(FileNotFoundError):
        read(tmp_path / "missing")


def test_large_files_are_refused_without_reading_them(tmp_path: Path):
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(700 * 2**20)  # sparse
    tracemalloc.start()
    with pytest.raises(OSError, match=r"larger than 16 MiB, the limit") as caught:
        read_file(path)
    assert caught.value.errno == errno.EFBIG
    assert end_of_file(path, 4) == "\0" * 4
    assert tracemalloc.get_traced_memory()[1] < 2**20
    tracemalloc.stop()


def test_an_archive_with_an_endless_list_of_files_is_refused(tmp_path: Path):
    path = tmp_path / "a.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.txt", "text")
    with open_file(path) as file, open_archive(file) as archive:
        assert archive.read("a.txt") == b"text"
    data = bytearray(path.read_bytes())
    at = data.rindex(b"PK\5\6") + 12
    data[at : at + 4] = (MOST_DIRECTORY_BYTES + 1).to_bytes(4, "little")
    path.write_bytes(data)
    with open_file(path) as file, pytest.raises(zipfile.BadZipFile, match="its list of files has"):
        open_archive(file)


TOO_LARGE = rf"too large: .* MiB of memory; the limit is 2048 MiB \(.*{VARIABLE}"
MANY = 18_000_000


def grown_mib(read: Callable[[], object]) -> float:
    """How far a read, which must fail, raises the peak of this process."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises((FrameError, ValueError), match=TOO_LARGE):
        read()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024


def test_a_depth_image_counts_as_points(tmp_path: Path):
    """Each pixel gives a point; as an image, it would be small enough."""
    side = 5000
    require_pixels(side, side)
    write_rgbd(tmp_path, {"0": (np.zeros((20, 20, 3), np.uint8), np.ones((side, side), np.uint16))})
    assert grown_mib(lambda: open_recording(tmp_path).frame(0)) < 50


def test_the_setting_raises_and_lowers_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    np.save(tmp_path / "a.npy", np.ones((100_000, 3), np.float32))
    savemat(tmp_path / "a.mat", {"instance": np.ones((100_000, 6))})
    assert len(read_cloud(tmp_path / "a.npy").xyz_m) == 100_000
    monkeypatch.setenv(VARIABLE, "1")
    with pytest.raises(FrameError, match=rf"limit is 1 MiB \(.*{VARIABLE} sets another, such as 2\)"):
        read_cloud(tmp_path / "a.npy")
    with pytest.raises(FrameError, match=f"larger than 0.5 MiB, .*raise {VARIABLE}"):
        _read_mat(tmp_path / "a.mat")
    monkeypatch.setenv(VARIABLE, "16")
    assert len(read_cloud(tmp_path / "a.npy").xyz_m) == 100_000
    monkeypatch.setenv(VARIABLE, "8 GB")
    with pytest.raises(ConfigError, match=f"{VARIABLE}='8 GB': must be a number of MiB"):
        frame_memory()


def test_compressed_columns_do_not_fill_the_memory(tmp_path: Path):
    feather.write_feather(pyarrow.table({"x": np.zeros(MANY, np.int8)}), tmp_path / "a.feather", chunksize=MANY)
    assert grown_mib(lambda: read_feather(tmp_path / "a.feather", {"x": "int"})) < 50


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
