"""`annotator doctor`: this machine, its packages, the backends that detectors use on it, and a self-test of these.

The checks run in a process of their own, so a library that crashes or hangs costs only one line of the report.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from enum import StrEnum
from functools import partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, requires, version
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import annotator
from annotator.child import Child, parent
from annotator.detection.backends.choose import Network, chosen, open_network
from annotator.detection.backends.network import Answer, usable_cores
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.pretrained import TITLE, base_weights, has_base
from annotator.detection.trained import read_trained
from annotator.detection.ultralytics_api import cache_dir
from annotator.files import read_text_file, sha256_of
from annotator.types.bases import Strict
from annotator.types.errors import AnnotatorError, MissingExtraError
from annotator.types.messages import amount

REPORT_VERSION = 2
# A shorter home folder, such as "/", occurs in many unrelated paths.
SHORTEST_HOME = 4
GIB = 2**30
# A training and each of two workers need a few hundred megabytes, and torch alone half a gigabyte.
LEAST_MEMORY_BYTES = 4 * GIB
# The models, exports and recordings of a project take hundreds of megabytes each.
LEAST_DISK_BYTES = 2 * GIB
DISTRIBUTION = "rcv-annotator"
REINSTALL = f"pip install --force-reinstall {DISTRIBUTION}"
REPORT_IT = "report this, with the whole output"
# System libraries that open3d and OpenCV load, and their packages in Debian and Ubuntu, as in scripts/setup.
SYSTEM_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
LIBRARY = re.compile(r"lib[\w.+-]*?\.so[\w.]*")


class State(StrEnum):
    """The state of a line. A missing optional package is ok; FAILED means that something does not work."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


class Line(Strict):
    """The result of one check.

    Attributes:
        section: section of the report, such as "machine" or "self-test".
        name: unique within its section.
        state: ok, warning or failed.
        found: the result in words.
        remedy: what the user should do; "" if nothing.
    """

    section: str
    name: str
    state: State
    found: str
    remedy: str = ""


class Report(Strict):
    report_version: int = REPORT_VERSION
    annotator_version: str
    lines: tuple[Line, ...]

    @property
    def failed(self) -> bool:
        return any(each.state is State.FAILED for each in self.lines)


def as_text(report: Report) -> Iterator[str]:
    """Yields the report as lines of plain text."""
    yield f"annotator {report.annotator_version}"
    width = max((len(each.name) for each in report.lines), default=0)
    for section, lines in groupby(report.lines, lambda each: each.section):
        yield from ("", f"{section}:")
        for each in lines:
            yield f"  {each.name:{width}}  {each.found}: {each.state.value}"
            if each.remedy:
                yield f"  {'':{width}}    -> {each.remedy}"
    counts = {state: sum(each.state is state for each in report.lines) for state in State}
    yield from ("", ", ".join(f"{count} {state.value}" for state, count in counts.items()))


def line(section: str, name: str, found: str, remedy: str = "", *, failed: bool = False) -> Line:
    """A line of the report; one with a remedy is a warning, unless the check has failed."""
    state = State.FAILED if failed else State.WARNING if remedy else State.OK
    return Line(section=section, name=name, state=state, found=found, remedy=remedy)


packages = partial(line, "packages")


def machine(projects: Path) -> Iterator[Line]:
    """Reports annotator's installation, Python, the system, the processor, memory and disks."""
    of = partial(line, "machine")
    yield of("annotator", f"{annotator.__version__} in {Path(annotator.__file__).parent}")
    yield of("Python", f"{platform.python_version()} ({platform.python_implementation()}) at {sys.executable}")
    yield of("system", platform.platform())
    model = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):
        lines = read_text_file(Path("/proc/cpuinfo"), errors="replace").splitlines()
        model = next(text.partition(":")[2].strip() for text in lines if text.startswith("model name"))
    yield of("processor", f"{model}, {amount(os.cpu_count() or 1, 'core')}, {usable_cores()} of them for this process")
    total, free = _memory_bytes()
    few = (
        "use --workers 1 in `annotator annotate`, and a small batch in trainings" if total < LEAST_MEMORY_BYTES else ""
    )
    yield of("memory", f"{total / GIB:.1f} GiB, {free / GIB:.1f} GiB free", few)
    for name, folder in (("disk of projects", projects.absolute()), ("disk of cache", cache_dir().absolute())):
        existing = next((each for each in (folder, *folder.parents) if each.exists()), folder)
        try:
            free = shutil.disk_usage(existing).free
        except OSError as error:
            yield of(name, f"{folder}: cannot be read ({error.strerror})", "choose another folder")
            continue
        remedy = "" if free >= LEAST_DISK_BYTES else "free some space, or choose a folder on another disk"
        if not os.access(existing, os.W_OK):
            remedy = "it cannot be written to; choose a folder that you may write to"
        yield of(name, f"{free / GIB:.1f} GiB free for {folder}", remedy)


def _memory_bytes() -> tuple[int, int]:
    """Returns total and free memory, limited to that of the container (cgroup v2)."""
    import psutil  # type: ignore[import-untyped]

    memory = psutil.virtual_memory()
    total = memory.total
    with suppress(OSError, ValueError):  # it says "max" without a limit
        total = min(total, int(read_text_file(Path("/sys/fs/cgroup/memory.max"))))
    return total, min(memory.available, total)


def requirements() -> dict[str, list[str]]:
    """The packages that annotator needs, by extra; "" are the required ones.

    Without those of certain systems only, open3d and OpenVINO, which have checks of their own.
    """
    found: dict[str, list[str]] = {}
    for text in requires(DISTRIBUTION) or ():
        spec, _, marker = text.partition(";")
        extra = re.search(r"extra == .([\w-]+)", marker)
        if extra is not None or not marker:
            names = found.setdefault("" if extra is None else extra[1], [])
            names += {re.split(r"[\[<>=! ]", spec)[0]} - {*names}
    return found


def installed(_: Path) -> Iterator[Line]:
    """Checks whether the required packages are installed, and tells which of the optional ones are."""
    try:
        every = requirements()
    except PackageNotFoundError:
        yield packages("required", "unknown, since annotator runs without being installed", "scripts/setup")
        return
    for extra, names in every.items():
        versions = {name: _version(name) for name in names}
        missing = ", ".join(name for name, known in versions.items() if known is None)
        known = ", ".join(f"{name} {known}" for name, known in versions.items() if known is not None)
        if not extra:
            if missing:
                yield packages("required", f"missing: {missing}", REINSTALL, failed=True)
            yield packages("versions", known)
        elif extra != "test":
            how = f'pip install "{DISTRIBUTION}[{extra}]"'
            some = f"{known}; {missing} is missing: {how}" if missing and known else known
            yield line("extras", extra, some or f"not installed: {how}")


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None


def ultralytics(_: Path) -> Iterator[Line]:
    """Checks whether ultralytics can be loaded, and lists the published weights on this machine."""
    from annotator.detection.pretrained import local_weights
    from annotator.detection.ultralytics_api import api

    missing = "without it, detectors cannot be trained or converted"
    found = _loaded("ultralytics", "ultralytics-opencv-headless", lambda: str(api().version), missing, failed=True)
    yield found
    if found.state is State.OK:
        none = "none; the first training downloads them, or starts from random weights"
        yield packages("published weights", ", ".join(map(str, local_weights())) or none)


def torch(_: Path) -> Iterator[Line]:
    """Reports the version of torch, and the CUDA devices that it can use."""
    from annotator.detection.backends.choose import driver_devices
    from annotator.detection.ultralytics_api import cuda_devices, torch_build

    found = _loaded("torch", "torch", torch_build, "detectors need it", failed=True)
    yield found
    if found.state is not State.OK:
        return
    try:
        devices = cuda_devices()
    except (RuntimeError, AssertionError) as error:
        remedy = "check the driver with nvidia-smi; the GPU cannot be used until this is fixed"
        yield packages("CUDA", _first_line(error), remedy, failed=True)
        return
    for device in devices:
        total, free = device.memory_bytes, device.free_bytes
        known = f"{device.model}, {free / GIB:.1f} of {total / GIB:.1f} GiB free"
        yield packages(device.name, known)
    if not devices and (number := driver_devices()):
        remedy = "install a torch with CUDA (pytorch.org shows the command), then run this again"
        yield packages("CUDA", f"the driver reports {number} device(s), but torch can use none", remedy)
    elif not devices:
        yield packages("CUDA", "no device")


def openvino(_: Path) -> Iterator[Line]:
    """Checks whether OpenVINO can be loaded, and lists its devices; missing, it matters on x86 processors only."""
    from annotator.detection.backends.openvino_network import computes_bfloat16
    from annotator.detection.backends.openvino_network import openvino as load

    def facts() -> str:
        module = load()
        half = "with bfloat16" if computes_bfloat16() else "without bfloat16"
        return f"{module.get_version()}, devices {', '.join(module.Core().available_devices)}; the processor {half}"

    matters = platform.machine().lower() in ("x86_64", "amd64")
    missing = "without it, detectors take several times as long on the processor" if matters else ""
    yield _loaded("OpenVINO", "openvino", facts, missing)


def numba(_: Path) -> Iterator[Line]:
    yield _loaded("numba", "numba", lambda: str(import_module("numba").__version__), "recursion needs it", failed=True)


def open3d(_: Path) -> Iterator[Line]:
    """Checks whether open3d, which needs the system's OpenGL, can be loaded."""

    def facts() -> str:
        return f"{import_module('open3d').__version__}, loads with this system's OpenGL"

    yield _loaded("open3d", "open3d", facts, "without it `annotator generate` and `annotator demo` do not work")


def _loaded(name: str, package: str, facts: Callable[[], str], without: str = "", *, failed: bool = False) -> Line:
    """The line of a package: its facts, or that it is not installed, or why it cannot be loaded.

    Args:
        without: what does not work without it; "" if it is optional.
        failed: whether the line has failed then.
    """
    if find_spec(package.partition("-")[0]) is None:
        return packages(name, "not installed", without and f"pip install {package}; {without}", failed=failed)
    try:
        return packages(name, facts())
    except Exception as error:  # the type depends on the cause, e.g. a missing library or an old processor
        message = _first_line((isinstance(error, MissingExtraError) and error.__cause__) or error)
    library, remedy = LIBRARY.search(message), f"pip install --force-reinstall {package}"
    if library and library[0] in SYSTEM_LIBRARIES:
        remedy = f"install the system library: apt-get install {SYSTEM_LIBRARIES[library[0]]} (Debian, Ubuntu)"
    return packages(name, f"cannot be loaded: {message}", remedy, failed=failed)


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def choices(_: Path) -> Iterator[Line]:
    """Reports which backend detectors would use, and why."""
    settings: tuple[Backend, ...] = ("auto", "fastest")
    for setting in settings:
        try:
            backend, reason = chosen(DetectorConfig(image_size_px=64, backend=setting))
            found, remedy = f"{backend} ({reason})", ""
        except AnnotatorError as error:
            found, remedy = f"none ({_first_line(error)})", "see the packages above"
        yield line("backends", setting, found, remedy, failed=bool(remedy))


def base_detector(_: Path) -> Iterator[Line]:
    """Reports whether this installation has the base detector, and can use it."""
    of = partial(line, "detectors", "base detector")
    if not has_base():
        yield of("not installed: a project needs a view detector of its own")
        return
    try:
        read_trained(base_weights().parent)
    except AnnotatorError as error:
        yield of(_first_line(error), "install annotator again", failed=True)
        return
    yield of(f"installed; in a project without a view detector, it is used as {TITLE}")


# Of the self-test's pictures, height and width: multiples of the network's stride, and different from those that
# exports are traced with.
PICTURE_PX = (96, 128)
# Largest root mean square differences from torch in single precision on the CPU: of box coordinates (pixels), scores
# (0 to 1) and the edges' spreads (pixels). Weights and pictures are always the same, so these were measured once: some
# twenty times the rounding of single precision, since Winograd convolutions lose up to three binary digits, and twice
# that of float16 (torch on GPUs multiplies with TF32, which has as many digits) and of bfloat16. A wrong graph, a wrong
# kernel or lost weights move boxes by pixels.
SINGLE, TF32, BFLOAT16 = (0.02, 1e-4, 0.02), (3.1, 0.018, 2.4), (15.0, 0.11, 10.0)
CONVERTED: tuple[Backend, ...] = ("openvino", "openvino-bf16")


def backends(_: Path) -> Iterator[Line]:
    """Compares the raw output of each backend with that of torch on the CPU, for a network with seeded weights."""
    from annotator.detection.backends.openvino_network import computes_bfloat16
    from annotator.detection.pretrained import write_seeded_network
    from annotator.detection.ultralytics_api import cuda_devices

    of = partial(line, "self-test")
    pictures = np.random.default_rng(0).integers(0, 256, (2, *PICTURE_PX, 3), np.uint8)
    with TemporaryDirectory() as temporary:
        # what the network is converted to stays out of the user's cache; this process ends with the last check
        os.environ["XDG_CACHE_HOME"] = temporary
        weights = Path(temporary) / "network.safetensors"

        def opened(backend: Backend, device: str = "cpu") -> Network:
            config = DetectorConfig(image_size_px=max(PICTURE_PX), backend=backend, device=device)
            return open_network(weights, sha256_of(weights), config)

        try:
            write_seeded_network(weights)
            expected = opened("torch").predict([pictures])[0]
            gpus = [device.name for device in cuda_devices()]
        except (AnnotatorError, ImportError, OSError, RuntimeError, AssertionError) as error:
            yield of("backends", f"not tested ({_first_line(error)})", "see the packages above")
            return
        tested: list[tuple[str, Callable[[], Network], tuple[float, float, float]]] = []
        for backend in CONVERTED:
            if find_spec("openvino") is not None:
                bounds = BFLOAT16 if backend == "openvino-bf16" else SINGLE
                tested.append((backend, partial(opened, backend), bounds))
            else:
                yield of(backend, "not installed; not tested")
        tested += [(f"torch, {name}", partial(opened, "torch", name), TF32) for name in gpus]
        for name, network, bounds in tested:
            try:
                if name == "openvino-bf16" and not computes_bfloat16():
                    yield of(name, "the processor does not support bfloat16; not tested")
                    continue
                answer = network().predict([pictures])[0]
            except AnnotatorError as error:
                yield of(name, str(error), REPORT_IT, failed=True)
                continue
            yield _compared(name, answer, expected, bounds)


def _compared(name: str, answer: Answer, expected: Answer, bounds: tuple[float, float, float]) -> Line:
    of = partial(line, "self-test", name)
    if answer.shape != expected.shape:
        return of(f"the output has shape {answer.shape}, torch's has {expected.shape}", REPORT_IT, failed=True)
    rows = np.split((answer.astype(np.float64) - expected) ** 2, [4, -4], axis=1)
    boxes, scores, spreads = found = [float(np.sqrt(each.mean())) for each in rows]
    holds = all(value <= bound for value, bound in zip(found, bounds, strict=True))  # False for NaN
    return of(
        f"differs from torch in single precision by {boxes:.2g} px (boxes), {scores:.2g} (scores) and {spreads:.2g} px "
        f"(spreads of edges); allowed: {bounds[0]:g} px, {bounds[1]:g} and {bounds[2]:g} px",
        "" if holds else f"use another --backend, and {REPORT_IT}",
        failed=not holds,
    )


Check = Callable[[Path], Iterator[Line]]
"""A function of this module, because it is pickled for another process; it gets the folder of projects."""

CHECKS: tuple[Check, ...] = (
    machine,
    installed,
    # before torch, because this check sets environment variables that torch and ultralytics read when they are loaded
    *(ultralytics, torch, openvino, numba, open3d),
    choices,
    base_detector,
    backends,
)
# Time after which a check counts as hanging, seconds: more than ten times what all take on two cores.
LIMIT_S = 180.0


def examine(projects: Path, checks: tuple[Check, ...] = CHECKS, limit_s: float = LIMIT_S) -> Report:
    """Runs all checks.

    Args:
        projects: the folder of projects, whose disk is checked; it need not exist.
        limit_s: maximum duration of a check, seconds.
    """
    lines: list[Line] = []
    left = checks
    while left:
        # if a check crashes or hangs its process, a new process runs the remaining ones
        for found in _in_process(left, projects, limit_s):
            lines += found
            left = left[1:]
    # grouped by section, whose first lines are in the order of the checks
    sections = list(dict.fromkeys(each.section for each in lines))
    lines.sort(key=lambda each: sections.index(each.section))
    return Report(annotator_version=annotator.__version__, lines=tuple(map(without_home, lines)))


def without_home(found: Line) -> Line:
    """Replaces the user's home folder in a line by `~`, so that the report does not contain the user's name."""
    texts = {"found": found.found, "remedy": found.remedy}
    for home in {str(Path.home()), str(Path.home().resolve())}:
        if len(home) >= SHORTEST_HOME:
            texts = {name: text.replace(home + os.sep, "~" + os.sep) for name, text in texts.items()}
    return found.model_copy(update=texts)


def _in_process(checks: tuple[Check, ...], projects: Path, limit_s: float) -> Iterator[list[Line]]:
    """Yields the lines of each check, all run in one process, up to the first check that crashes it or hangs."""
    with closing(Child(f"{__name__}:main")) as child:
        child.send((checks, projects))
        for check in checks:
            begin_s = time.monotonic()
            try:
                with child.within(limit_s):
                    lines = child.receive()
            except EOFError:
                code, is_late = child.process.wait(), time.monotonic() - begin_s >= limit_s
                ending = signal.Signals(-code).name if -code in signal.valid_signals() else f"exit code {code}"
                yield [_lost(check, f"did not finish within {limit_s:.0f} s" if is_late else f"crashed ({ending})")]
                return
            yield lines


def main() -> None:
    """Runs in the other process: sends the lines of each check, the last of which tells of an exception."""
    pipe = parent()
    checks, projects = pipe.receive()
    for check in checks:
        lines: list[Line] = []
        try:
            lines += check(projects)
        except Exception as error:  # a broken library may raise anything
            lines.append(_lost(check, f"{type(error).__name__}: {error}".splitlines()[0]))
        pipe.send(lines)


def _lost(check: Check, why: str) -> Line:
    return line("failed checks", check.__name__, why, REPORT_IT, failed=True)
