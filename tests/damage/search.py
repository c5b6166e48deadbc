"""Reads damaged files, thousands for each reader and parser, and reports what is handled badly (`scripts/fuzz files`).

Each file must give a frame or labels, or one of annotator's own errors: nothing else raised, no crash of the process,
nothing that takes longer than `MOST_S`, and no more than `MOST_MORE` bytes beyond what the frame itself needs
(`annotator.frame_limits`). A process reads the files of a target, one after another; another one watches it and starts
it again after a crash.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parent.parent
# of the samples
ROOMS = ("damage", "formats", "recordings", "recordings/kinect", "recordings/clouds")
sys.path[:0] = [place for place in (*(str(TESTS / room) for room in ROOMS), str(TESTS.parent)) if place not in sys.path]

from damage import damaged  # noqa: E402

MOST_S = 10.0
MOST_MORE = 1 << 30
# Ends what would fill the machine's memory.
MOST_ADDRESSES = 16 << 30
# A child that is silent for longer hangs for good; what ends after `MOST_S` is reported, too.
PATIENCE_S = 120.0
FORK = multiprocessing.get_context("fork")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=2000, help="damaged files of each target")
    parser.add_argument("--only", default="", help="targets whose name contains this")
    parser.add_argument("--keep", type=Path, help="folder for the files that were not handled well")
    given = parser.parse_args()
    from targets import TARGETS

    began, found, total = time.monotonic(), 0, 0
    names = [target.name for target in TARGETS if given.only in target.name]
    for name in names:
        kinds, problems, slowest_s, most_bytes = watch(name, given)
        print(
            f"{name:28} {kinds.total():6} files: {kinds['read']:5} read, {kinds['refused']:5} refused, {len(problems)} "
            f"problems; at most {slowest_s:.2f} s, {most_bytes / 2**20:.0f} MiB more",
            *problems, sep="\n    ", flush=True,
        )  # fmt: skip
        found, total = found + len(problems), total + kinds.total()
    print(f"{len(names)} targets, {total} files, seed {given.seed}: {found} problems; {time.monotonic() - began:.0f} s")
    return 1 if found else 0


def watch(name: str, given: argparse.Namespace) -> tuple[Counter[str], list[str], float, int]:
    """Has children read the files of a target, another one after a crash or hang.

    Returns what came of the files, the problems, the longest time (s), and the most bytes.
    """
    kinds, problems, slowest_s, most_bytes, start = Counter[str](), list[str](), 0.0, 0, 0
    while start < given.count:
        ours, theirs = FORK.Pipe(duplex=False)
        with tempfile.TemporaryFile() as errors, suppress(EOFError):
            child = FORK.Process(target=read_all, args=(theirs, errors.fileno(), name, given, start))
            child.start()
            theirs.close()
            number = start - 1
            while ours.poll(PATIENCE_S):
                number, result = ours.recv()
                if result:
                    kinds[result["kind"]] += 1
                    slowest_s, most_bytes = max(slowest_s, result["took_s"]), max(most_bytes, result["more_bytes"])
                    problems += [f"{number}: {result['problem']}"] if result["problem"] else []
            child.kill()
        child.join()
        if child.exitcode == 0:
            break
        problems.append(f"{number}: ends the process, or hangs for more than {PATIENCE_S:g} s ({child.exitcode})")
        kinds["ended"] += 1
        # if it cannot even be built, no other file can be tried
        start = given.count if number < start else number + 1
    return kinds, problems, slowest_s, most_bytes


def read_all(told: Any, errors: int, name: str, given: argparse.Namespace, start: int) -> None:
    """Reads the damaged files of a target from number `start` on; tells each number before, and the result after."""
    from targets import TARGETS

    resource.setrlimit(resource.RLIMIT_AS, (MOST_ADDRESSES, MOST_ADDRESSES))
    # what libraries print
    os.dup2(errors, 1)
    os.dup2(errors, 2)
    target = next(target for target in TARGETS if target.name == name)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "take_freiburg"
        folder.mkdir()
        target.build(folder)
        files = sorted(file for file in folder.rglob("*") if file.is_file())
        target.read(folder)
        for number in range(start, given.count):
            told.send((number, {}))
            with one_damaged(folder, files, f"{given.seed} {name} {number}") as file:
                result = examine(target, folder)
                if result["problem"]:
                    result["problem"] += f" [{file.relative_to(folder)}]"
                    if given.keep:
                        shutil.copytree(folder, given.keep / f"{name}_{given.seed}_{number}", dirs_exist_ok=True)
            told.send((number, result))


@contextmanager
def one_damaged(folder: Path, files: list[Path], seed: str) -> Iterator[Path]:
    """Damages one of a folder's files, the same for the same seed, and mends it at the end."""
    draw = random.Random(seed)
    file = draw.choice(files)
    whole = file.read_bytes()
    file.write_bytes(damaged(whole, file.suffix, draw))
    try:
        yield file
    finally:
        file.write_bytes(whole)


def examine(target: Any, folder: Path) -> dict[str, Any]:
    """Reads a damaged recording or dataset; says what came of it."""
    from annotator.frame_limits import PIXEL_BYTES, POINT_BYTES
    from annotator.types import Frame
    from annotator.types.errors import AnnotatorError

    problem, kind, own = "", "read", 0
    # the peak is counted from here
    Path("/proc/self/clear_refs").write_text("5")
    before, began = memory("VmRSS"), time.monotonic()
    try:
        frame = target.read(folder)
        if isinstance(frame, Frame):
            own = len(frame.cloud) * POINT_BYTES + frame.rgb[:, :, 0].size * PIXEL_BYTES
    except AnnotatorError as error:
        kind = "refused"
        if str(folder) not in str(error) and folder.name not in str(error):
            problem = f"its error names no file: {error}"
    except BaseException as error:
        kind = "raised"
        at = traceback.extract_tb(error.__traceback__)[-1]
        problem = f"raises {type(error).__name__} at {Path(at.filename).name}:{at.lineno}: {str(error)[:200]}"
    took_s, more = time.monotonic() - began, max(memory("VmHWM") - before, 0)
    if took_s > MOST_S:
        problem = problem or f"takes {took_s:.1f} s"
    if more - own > MOST_MORE:
        problem = problem or f"takes {more / 2**20:.0f} MiB, the frame itself {own / 2**20:.0f} MiB"
    return {"kind": kind, "problem": problem, "took_s": took_s, "more_bytes": more}


def memory(name: str) -> int:
    """Returns a line of the process's status, in bytes."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) * 1024


if __name__ == "__main__":
    sys.exit(main())
