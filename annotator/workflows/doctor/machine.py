"""Facts about the machine: Python, system, processor, memory and disks."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import annotator
from annotator.detection.backends.network import usable_cores
from annotator.detection.ultralytics_api import cache_dir
from annotator.files import read_text_file
from annotator.types.messages import amount
from annotator.workflows.doctor.report import Line, State

SECTION = "machine"
GIB = 2**30
# A training and each of two workers need a few hundred megabytes, and torch alone half a gigabyte.
LEAST_MEMORY_BYTES = 4 * GIB
# The models, exports and recordings of a project take hundreds of megabytes each.
LEAST_DISK_BYTES = 2 * GIB


def machine(projects: Path) -> Iterator[Line]:
    """Yields lines about annotator's installation, Python, system, processor, memory and disks."""
    yield Line(
        section=SECTION,
        name="annotator",
        state=State.OK,
        found=f"{annotator.__version__} in {Path(annotator.__file__).parent}",
    )
    version = f"{platform.python_version()} ({platform.python_implementation()}) at {sys.executable}"
    yield Line(section=SECTION, name="Python", state=State.OK, found=version)
    yield Line(section=SECTION, name="system", state=State.OK, found=_system())
    cores, usable = os.cpu_count() or 1, usable_cores()
    processor = f"{_processor()}, {amount(cores, 'core')}" + (
        f", {usable} of them for this process" if usable < cores else ""
    )
    figures: dict[str, float] = {"cores": cores, "usable_cores": usable}
    yield Line(section=SECTION, name="processor", state=State.OK, found=processor, figures=figures)
    yield _memory()
    yield _disk("disk of projects", projects)
    yield _disk("disk of cache", cache_dir())


def _system() -> str:
    try:
        name = platform.freedesktop_os_release().get("PRETTY_NAME", "")
    except (OSError, AttributeError):  # not Linux
        name = ""
    libc = " ".join(platform.libc_ver()).strip()
    return ", ".join(filter(None, [name, f"{platform.system()} {platform.release()} {platform.machine()}", libc]))


def _processor() -> str:
    for line in _lines(Path("/proc/cpuinfo")):
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory() -> Line:
    total, free = _memory_bytes()
    if total is None:
        return Line(section=SECTION, name="memory", state=State.OK, found="unknown on this system")
    figures: dict[str, float] = {"total_bytes": total}
    size = f"{total / GIB:.1f} GiB"
    if free is not None:
        figures["free_bytes"] = free
        size += f", {free / GIB:.1f} GiB free"
    little = total < LEAST_MEMORY_BYTES
    remedy = "use --workers 1 in `annotator annotate`, and a small batch in trainings" if little else ""
    state = State.WARNING if little else State.OK
    return Line(section=SECTION, name="memory", state=state, found=size, remedy=remedy, figures=figures)


def _memory_bytes() -> tuple[int | None, int | None]:
    """Returns total and free memory, limited to that of the container (cgroup v2); None if unknown."""
    known = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in _lines(Path("/proc/meminfo")) if "kB" in line}
    total, free = known.get("MemTotal"), known.get("MemAvailable")
    if total is None and hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    limit = next(iter(_lines(Path("/sys/fs/cgroup/memory.max"))), "max").strip()
    if total is not None and limit.isdigit() and int(limit) < total:
        total = int(limit)
        free = None if free is None else min(free, total)
    return total, free


def _lines(path: Path) -> list[str]:
    """Returns the lines of a system file; empty if it cannot be read."""
    try:
        return read_text_file(path, errors="replace").splitlines()
    except OSError:
        return []


def _disk(name: str, folder: Path) -> Line:
    existing = folder.absolute()
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        free = shutil.disk_usage(existing).free
    except OSError as error:
        problem = f"{folder.absolute()}: cannot be read ({error.strerror})"
        return Line(section=SECTION, name=name, state=State.WARNING, found=problem, remedy="choose another folder")
    writable = os.access(existing, os.W_OK)
    space = f"{free / GIB:.1f} GiB free for {folder.absolute()}" + ("" if writable else ", which cannot be written to")
    remedy = "" if free >= LEAST_DISK_BYTES else "free some space, or choose a folder on another disk"
    remedy = remedy if writable else "choose a folder that you may write to"
    state = State.WARNING if remedy else State.OK
    return Line(section=SECTION, name=name, state=state, found=space, remedy=remedy, figures={"free_bytes": free})
