"""Runs the checks in a separate process, so that a library that crashes or hangs costs only one line of the report."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from pathlib import Path

from annotator import __version__
from annotator.workflows.doctor import packages, self_test
from annotator.workflows.doctor.machine import machine
from annotator.workflows.doctor.report import Line, Report, State, without_home

Check = Callable[[Path], Iterator[Line]]
# Time after which a check counts as hanging, seconds. Compiling the kernels alone takes half a minute.
LIMIT_S = 180.0
REPORT_IT = "report this, with the whole output"

CHECKS: Mapping[str, Check] = {
    "machine": machine,
    "required": packages.required,
    # before torch, because this check sets environment variables that torch and ultralytics read when they are loaded
    "ultralytics": packages.ultralytics,
    "torch": packages.torch,
    "openvino": packages.openvino,
    "onnxruntime": packages.onnxruntime,
    "numba": packages.numba,
    "open3d": packages.open3d,
    "extras": packages.extras,
    "kinect": packages.kinect,
    "choices": packages.choices,
    "base detector": packages.base_detector,
    "backends": self_test.backends,
}


def examine(projects: Path, checks: Mapping[str, Check] = CHECKS, limit_s: float = LIMIT_S) -> Report:
    """Runs all checks.

    Args:
        projects: the folder of projects, whose disk is checked; it need not exist.
        checks: the checks by name; module-level functions, because they are pickled for another process.
        limit_s: maximum duration of a check, seconds.
    """
    lines: list[Line] = []
    left = dict(checks)
    while left:
        # if a check crashes or hangs its process, a new process runs the remaining ones
        for name, check_lines in _in_process(dict(left), projects, limit_s):
            lines.extend(check_lines)
            del left[name]
    return Report(annotator_version=__version__, lines=tuple(map(without_home, lines)))


def _in_process(checks: Mapping[str, Check], projects: Path, limit_s: float) -> Iterator[tuple[str, list[Line]]]:
    """Yields the lines of each check, all run in one process, up to the first check that crashes it or hangs."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(checks, projects, sender), daemon=True)
    process.start()
    sender.close()
    try:
        for name in checks:
            if not receiver.poll(limit_s):
                yield name, [_lost(name, f"did not finish within {limit_s:.0f} s")]
                return
            try:
                yield name, receiver.recv()
            except EOFError:
                process.join()
                yield name, [_lost(name, f"crashed ({_ending(process.exitcode)})")]
                return
    finally:
        process.kill()
        process.join()
        receiver.close()


def _work(checks: Mapping[str, Check], projects: Path, pipe: Connection) -> None:
    """Runs in the other process: runs the checks one after another and sends the lines of each."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent process ends this one
    os.dup2(2, 1)  # output of libraries goes to standard error, because the report is printed to standard output
    for name, check in checks.items():
        pipe.send(run_check(name, check, projects))


def run_check(name: str, check: Check, projects: Path) -> list[Line]:
    """Returns the lines of a check; if it raises an exception, the last line reports this."""
    lines: list[Line] = []
    try:
        lines.extend(check(projects))
    except Exception as error:  # a broken library may raise anything
        lines.append(_lost(name, f"{type(error).__name__}: {error}".splitlines()[0]))
    return lines


def _lost(name: str, why: str) -> Line:
    return Line(section="failed checks", name=name, state=State.FAILED, found=why, remedy=REPORT_IT)


def _ending(code: int | None) -> str:
    if code is None or code >= 0:
        return f"exit code {code}"
    try:
        return signal.Signals(-code).name
    except ValueError:
        return f"signal {-code}"
