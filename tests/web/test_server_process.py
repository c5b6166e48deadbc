"""The process of a server: memory, what is loaded ahead, and one server a projects folder."""

from __future__ import annotations

import errno
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from annotator.types.errors import ConfigError
from annotator.web.folders import hold_server_lock

# Prints how many MB 80 MB of freed pieces still take, the heaps after 16 threads have allocated at once, and whether
# objects are left out of collections: at first, without new modules, after one was loaded, and at the end. Then it
# prints what is loaded before and after `preload`.
TIDY = """
import ctypes, gc, sys, threading, time
from annotator.web.background import preload, tidy_heaps
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fdopen.restype = ctypes.c_void_p
rss = lambda: int(open("/proc/self/statm").read().split()[1]) >> 8

def allocate():
    barrier.wait()
    libc.malloc(100_000)
    barrier.wait()

def becomes_true(condition, within_s):
    ends = time.monotonic() + within_s
    while not condition() and time.monotonic() < ends:
        time.sleep(0.01)
    return condition()

with tidy_heaps(0.01):
    barrier = threading.Barrier(16)
    threads = [threading.Thread(target=allocate) for _ in range(16)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    before = rss()
    pieces = [ctypes.c_void_p(libc.malloc(20_000)) for _ in range(4000)]
    [ctypes.memset(piece, 1, 20_000) for piece in pieces]
    [libc.free(piece) for piece in pieces[:-1]]
    print(becomes_true(lambda: rss() - before <= 20, 60))
    first = becomes_true(gc.get_freeze_count, 10) > 0
    number, kept = gc.get_freeze_count() + 900, [[] for _ in range(1000)]
    without = becomes_true(lambda: gc.get_freeze_count() > number, 0.2)
    import sqlite3.dump
    print(first, without, becomes_true(lambda: gc.get_freeze_count() > number, 10))
print(gc.get_freeze_count())
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
sys.stdout.flush()
libc.malloc_info(0, out)
libc.fflush(out)
late = {"numba", "viser"}
print("loaded late:", sorted(late & set(sys.modules)))
preload().join()
from annotator.geometry.kernels import points_in_box
print("loaded ahead:", sorted(late & set(sys.modules)), bool(points_in_box.signatures))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the heaps of glibc")
def test_memory_is_kept_tidy_and_what_the_first_page_needs_is_loaded_ahead() -> None:
    # these may set another number of heaps, or another allocator
    set_elsewhere = ("MALLOC_", "GLIBC_TUNABLES", "LD_PRELOAD")
    plain = {name: value for name, value in os.environ.items() if not name.startswith(set_elsewhere)}
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", TIDY], capture_output=True, text=True, check=True, env=plain, cwd=root)
    assert done.stdout.splitlines()[:3] == ["True", "True False True", "0"]
    assert done.stdout.count("<heap nr=") <= 2
    loaded = ["loaded late: []", "loaded ahead: ['numba', 'viser'] True"]
    assert done.stdout.splitlines()[-2:] == loaded, "with the compiled functions"


def test_a_second_server_is_refused_while_the_first_one_runs(tmp_path: Path) -> None:
    with hold_server_lock(tmp_path / "projects"):
        with (
            pytest.raises(ConfigError, match=r"projects: another `annotator serve` uses these projects"),
            hold_server_lock(tmp_path / "projects"),
        ):
            pass
        with hold_server_lock(tmp_path / "others"):
            pass
    with hold_server_lock(tmp_path / "projects"):
        pass


def test_a_file_system_without_locks_causes_only_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(file: object, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", refuse)
    with hold_server_lock(tmp_path / "projects"):
        assert "does not support locks (No locks available)" in caplog.text


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "projects").write_text("a file")
    with (
        pytest.raises(ConfigError, match="choose another folder with --projects"),
        hold_server_lock(tmp_path / "projects"),
    ):
        pass
