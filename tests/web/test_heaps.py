"""The heaps that the C library gives to threads."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

# Prints how many MB 80 MB of freed pieces still take, and the heaps after 16 threads have allocated at once.
COUNT = """
import contextlib, ctypes, sys, threading, time
sys.path.insert(0, sys.argv[1])
from annotator.web.background import tidy_heaps
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fdopen.restype = ctypes.c_void_p
rss = lambda: int(open("/proc/self/statm").read().split()[1]) >> 8
def allocate():
    barrier.wait()
    libc.malloc(100_000)
    barrier.wait()
with tidy_heaps(0.01) if sys.argv[2] == "tidy" else contextlib.nullcontext():
    barrier = threading.Barrier(16)
    threads = [threading.Thread(target=allocate) for _ in range(16)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    before = rss()
    pieces = [ctypes.c_void_p(libc.malloc(20_000)) for _ in range(4000)]
    [ctypes.memset(piece, 1, 20_000) for piece in pieces]
    [libc.free(piece) for piece in pieces[:-1]]
    end = time.monotonic() + (60 if sys.argv[2] == "tidy" else 0)
    while rss() - before > 20 and time.monotonic() < end:
        time.sleep(0.01)
    print("rest", rss() - before)
out = ctypes.c_void_p(libc.fdopen(1, b"w"))
sys.stdout.flush()
libc.malloc_info(0, out)
libc.fflush(out)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the heaps of glibc")
def test_threads_share_two_heaps_and_free_memory_is_returned() -> None:
    # these may set another number of heaps, or another allocator
    set_elsewhere = ("MALLOC_", "GLIBC_TUNABLES", "LD_PRELOAD")
    plain = {name: value for name, value in os.environ.items() if not name.startswith(set_elsewhere)}
    said = {}
    for how in ("tidy", "default"):
        command = [sys.executable, "-c", COUNT, str(Path(__file__).parents[2]), how]
        said[how] = subprocess.run(command, capture_output=True, text=True, check=True, env=plain).stdout
    assert said["tidy"].count("<heap nr=") <= 2 < said["default"].count("<heap nr=")
    rest = {how: int(text.split()[1]) for how, text in said.items()}
    assert rest["tidy"] <= 20 < rest["default"], rest


# Prints whether objects are left out of collections: at first, without new modules, and after one was loaded.
LEFT_OUT = """
import gc, time
from annotator.web.background import tidy_heaps

def grows_beyond(number, within_s):
    ends = time.monotonic() + within_s
    while gc.get_freeze_count() <= number and time.monotonic() < ends:
        time.sleep(0.01)
    return gc.get_freeze_count() > number

with tidy_heaps(0.01):
    first = grows_beyond(0, 10)
    number, kept = gc.get_freeze_count() + 900, [[] for _ in range(1000)]
    without = grows_beyond(number, 0.5)
    import sqlite3.dump
    print(first, without, grows_beyond(number, 10))
print(gc.get_freeze_count())
"""


def test_garbage_collections_leave_out_what_modules_hold() -> None:
    command = [sys.executable, "-c", LEFT_OUT]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2])
    assert done.stdout.split() == ["True", "False", "True", "0"]
