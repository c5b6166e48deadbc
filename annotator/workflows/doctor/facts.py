"""Facts about the machine and its packages: whether each can be loaded, and which devices it can use."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache, partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path

import annotator
from annotator.detection.backends.choose import chosen
from annotator.detection.backends.network import usable_cores
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.pretrained import TITLE, base_weights, has_base
from annotator.detection.trained import read_trained
from annotator.detection.ultralytics_api import cache_dir
from annotator.files import read_text_file
from annotator.types import DetectorKind
from annotator.types.errors import AnnotatorError, DeviceError, MissingExtraError
from annotator.types.messages import amount
from annotator.workflows.doctor.report import Line, State

MACHINE = "machine"
GIB = 2**30
# A training and each of two workers need a few hundred megabytes, and torch alone half a gigabyte.
LEAST_MEMORY_BYTES = 4 * GIB
# The models, exports and recordings of a project take hundreds of megabytes each.
LEAST_DISK_BYTES = 2 * GIB


def machine(projects: Path) -> Iterator[Line]:
    """Yields lines about annotator's installation, Python, system, processor, memory and disks."""
    yield Line(
        section=MACHINE,
        name="annotator",
        state=State.OK,
        found=f"{annotator.__version__} in {Path(annotator.__file__).parent}",
    )
    version = f"{platform.python_version()} ({platform.python_implementation()}) at {sys.executable}"
    yield Line(section=MACHINE, name="Python", state=State.OK, found=version)
    yield Line(section=MACHINE, name="system", state=State.OK, found=_system())
    cores, usable = os.cpu_count() or 1, usable_cores()
    processor = f"{_processor()}, {amount(cores, 'core')}" + (
        f", {usable} of them for this process" if usable < cores else ""
    )
    figures: dict[str, float] = {"cores": cores, "usable_cores": usable}
    yield Line(section=MACHINE, name="processor", state=State.OK, found=processor, figures=figures)
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
        return Line(section=MACHINE, name="memory", state=State.OK, found="unknown on this system")
    figures: dict[str, float] = {"total_bytes": total}
    size = f"{total / GIB:.1f} GiB"
    if free is not None:
        figures["free_bytes"] = free
        size += f", {free / GIB:.1f} GiB free"
    little = total < LEAST_MEMORY_BYTES
    remedy = "use --workers 1 in `annotator annotate`, and a small batch in trainings" if little else ""
    state = State.WARNING if little else State.OK
    return Line(section=MACHINE, name="memory", state=state, found=size, remedy=remedy, figures=figures)


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
        return Line(section=MACHINE, name=name, state=State.WARNING, found=problem, remedy="choose another folder")
    writable = os.access(existing, os.W_OK)
    space = f"{free / GIB:.1f} GiB free for {folder.absolute()}" + ("" if writable else ", which cannot be written to")
    remedy = "" if free >= LEAST_DISK_BYTES else "free some space, or choose a folder on another disk"
    remedy = remedy if writable else "choose a folder that you may write to"
    state = State.WARNING if remedy else State.OK
    return Line(section=MACHINE, name=name, state=state, found=space, remedy=remedy, figures={"free_bytes": free})


SECTION = "packages"
DISTRIBUTION = "rcv-annotator"
REINSTALL = f"pip install --force-reinstall {DISTRIBUTION}"
# The other packages that the program imports, by module name.
REQUIRED = (
    *("numpy", "scipy", "cv2", "pydantic", "jaxtyping", "yaml", "sqlalchemy", "av", "matplotlib", "fsspec"),
    *("safetensors", "tyro", "rich", "viser", "fastapi", "uvicorn", "websockets", "httpx", "plotly"),
)
EXTRAS = {
    "kinect": ("pyk4a",),
    "ray": ("ray",),
    "onnx": ("onnxruntime", "onnx"),
    "las": ("laspy", "lazrs"),
    "ros": ("rosbags", "google.protobuf"),
    "phones": ("lzfse",),
    "argoverse": ("pyarrow",),
    "desktop": ("webview",),
}
# System libraries that open3d and OpenCV load, and their packages in Debian and Ubuntu, as in scripts/setup.
SYSTEM_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
LIBRARY = re.compile(r"lib[\w.+-]*?\.so[\w.]*")
KERNELS = ("annotator.geometry.kernels", "annotator.rcv.drawing_kernels", "annotator.rcv.fit_kernels")


def required(_: Path) -> Iterator[Line]:
    """Checks whether the packages of `REQUIRED` are installed, and lists their versions."""
    missing = [name for name in REQUIRED if find_spec(name) is None]
    if missing:
        names = f"missing: {', '.join(missing)}"
        yield Line(section=SECTION, name="required", state=State.FAILED, found=names, remedy=REINSTALL)
    versions = ", ".join(f"{name} {_version(name)}" for name in REQUIRED if name not in missing)
    yield Line(section=SECTION, name="versions", state=State.OK, found=versions)


def torch(_: Path) -> Iterator[Line]:
    """Reports the version of torch, and the CUDA devices that it can use."""
    from annotator.detection.ultralytics_api import cuda_devices, torch_facts

    try:
        facts = torch_facts()
    except (ImportError, OSError) as error:
        yield _broken("torch", "torch", error, State.FAILED)
        return
    built = f"built for CUDA {facts.cuda}" if facts.cuda else "built without CUDA"
    build = f"{facts.version}, {built}" + (", with Apple's MPS" if facts.has_mps else "")
    yield Line(section=SECTION, name="torch", state=State.OK, found=build)
    try:
        devices = cuda_devices()
    except (RuntimeError, AssertionError) as error:
        remedy = "check the driver with nvidia-smi; the GPU cannot be used until this is fixed"
        yield Line(section=SECTION, name="CUDA", state=State.FAILED, found=_first_line(error), remedy=remedy)
        return
    for device in devices:
        gib = f"{device.free_bytes / 2**30:.1f} of {device.memory_bytes / 2**30:.1f} GiB free"
        model = f"{device.model}, compute capability {device.capability}, {gib}"
        figures: dict[str, float] = {"memory_bytes": device.memory_bytes, "free_bytes": device.free_bytes}
        yield Line(section=SECTION, name=device.name, state=State.OK, found=model, figures=figures)
    if devices:
        return
    from annotator.detection.backends.choose import driver_devices

    number = driver_devices()
    remedy = "install a torch with CUDA (pytorch.org shows the command), then run this again" if number else ""
    devices_text = f"the driver reports {number} device(s), but torch can use none" if number else "no device"
    state = State.WARNING if number else State.OK
    yield Line(section=SECTION, name="CUDA", state=state, found=devices_text, remedy=remedy)


def ultralytics(_: Path) -> Iterator[Line]:
    """Checks whether ultralytics can be loaded, and lists the published weights on this machine."""
    from annotator.detection.pretrained import local_weights
    from annotator.detection.ultralytics_api import api

    package = "ultralytics-opencv-headless"
    remedy = f"pip install {package}; without it, detectors cannot be trained or converted"
    missing = Line(section=SECTION, name="ultralytics", state=State.FAILED, found="not installed", remedy=remedy)
    line = _checked("ultralytics", package, lambda: str(api().version), missing)
    yield line
    if line.state is State.OK:
        weights = ", ".join(map(str, local_weights()))
        none = "none; the first training downloads them, or starts from random weights"
        yield Line(section=SECTION, name="published weights", state=State.OK, found=weights or none)


def openvino(_: Path) -> Iterator[Line]:
    """Checks whether OpenVINO can be loaded, and lists its devices; missing, it matters on x86 processors only."""
    from annotator.detection.backends.openvino_network import computes_bfloat16
    from annotator.detection.backends.openvino_network import openvino as load

    def facts() -> str:
        module = load()
        half = "with bfloat16" if computes_bfloat16() else "without bfloat16"
        return f"{module.get_version()}, devices {', '.join(module.Core().available_devices)}; the processor {half}"

    missing = Line(section=SECTION, name="OpenVINO", state=State.OK, found="not installed; not used on this processor")
    if platform.machine().lower() in ("x86_64", "amd64"):
        remedy = "pip install openvino; without it, detectors take several times as long on the processor"
        missing = Line(section=SECTION, name="OpenVINO", state=State.WARNING, found="not installed", remedy=remedy)
    yield _checked("OpenVINO", "openvino", facts, missing, State.WARNING)


def onnxruntime(_: Path) -> Iterator[Line]:
    """Checks whether ONNX Runtime can be loaded, and lists its providers."""
    from annotator.detection.backends.onnx_network import onnxruntime as load

    def facts() -> str:
        module = load()
        return f"{module.__version__}, providers {', '.join(module.get_available_providers())}"

    missing = Line(section=SECTION, name="ONNX Runtime", state=State.OK, found="not installed (extra onnx)")
    yield _checked("ONNX Runtime", "onnxruntime", facts, missing, State.WARNING)


def numba(_: Path) -> Iterator[Line]:
    """Checks whether numba can be loaded, and counts the kernels whose machine code is in its cache."""
    from annotator.compiled import cached_code, is_compiled

    try:
        modules = [import_module(name) for name in KERNELS]
    except (ImportError, OSError) as error:
        yield _broken("numba", "numba", error, State.FAILED)
        return
    # functions that a module imports from another module are counted there
    functions = {
        f"{value.__module__}.{name}": value
        for module in modules
        for name, value in vars(module).items()
        if is_compiled(value) and value.__module__ == module.__name__
    }
    kept = [cached_code(function) for function in functions.values()]
    folders = sorted({str(folder) for folder, _ in kept if folder is not None})
    done, number = sum(is_kept for _, is_kept in kept), len(kept)
    compiled = f"{done} of {number} kernels are compiled, each on its first use"
    cache = f"{_version('numba')}; {compiled}; cached in {', '.join(folders) or 'no folder'}"
    figures: dict[str, float] = {"kernels": number, "compiled": done}
    remedy = ""
    if not folders:
        remedy = "every process compiles for half a minute; set NUMBA_CACHE_DIR to a folder that you may write to"
    elif not done:
        remedy = "the first use takes half a minute; `python -m annotator.workflows.warm_up` compiles them now"
    state = State.WARNING if remedy else State.OK
    yield Line(section=SECTION, name="numba", state=state, found=cache, remedy=remedy, figures=figures)


def open3d(_: Path) -> Iterator[Line]:
    """Checks whether open3d, which needs the system's OpenGL, can be loaded and casts rays."""
    import numpy as np

    from annotator.synthetic.render import RayScene

    def facts() -> str:
        corners = np.array([[-1, -1, 2], [1, -1, 2], [0, 1, 2]], np.float32)
        scene = RayScene(corners, np.array([[0, 1, 2]], np.int32))
        scene.first_hits(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
        return f"{_version('open3d')}, loads with this system's OpenGL and casts rays"

    remedy = f"{REINSTALL}; without it `annotator generate` and `annotator demo` do not work"
    missing = Line(section=SECTION, name="open3d", state=State.WARNING, found="not installed", remedy=remedy)
    yield _checked("open3d", "open3d", facts, missing)


def extras(_: Path) -> Iterator[Line]:
    """Reports which optional packages are installed, by extra."""
    for extra, modules in EXTRAS.items():
        missing = [name for name in modules if find_spec(name) is None]
        versions = ", ".join(f"{name} {_version(name)}" for name in modules if name not in missing)
        facts = versions
        if missing:
            install = f'pip install "{DISTRIBUTION}[{extra}]"'
            facts = (
                f"{versions}; {', '.join(missing)} is missing: {install}" if versions else f"not installed: {install}"
            )
        yield Line(section="extras", name=extra, state=State.OK, found=facts)


def kinect(_projects: Path) -> Iterator[Line]:
    """Reports the number of connected Azure Kinects, if their library is installed."""
    from annotator.recordings.kinect.device import load_pyk4a

    if find_spec("pyk4a") is None:
        return
    try:
        count = int(load_pyk4a().connected_device_count())
    except DeviceError as error:
        problem, _, remedy = _first_line(error).partition("; ")
        yield Line(section="extras", name="Azure Kinect", state=State.WARNING, found=problem, remedy=remedy)
        return
    yield Line(section="extras", name="Azure Kinect", state=State.OK, found=f"{count} connected")


def choices(_: Path) -> Iterator[Line]:
    """Reports which backend each detector would use, and why."""
    settings: tuple[Backend, ...] = ("auto", "fastest")
    for setting in settings:
        try:
            backend, reason = chosen(DetectorConfig(image_size_px=64, backend=setting))
            state, choice = State.OK, f"{backend} ({reason})"
        except AnnotatorError as error:
            state, choice = State.FAILED, f"none ({_first_line(error)})"
        for role in DetectorKind:
            remedy = "" if state is State.OK else "see the packages above"
            yield Line(section="backends", name=f"{role}, {setting}", state=state, found=choice, remedy=remedy)


def base_detector(_: Path) -> Iterator[Line]:
    """Reports whether this installation has the base detector, and can use it."""
    line = partial(Line, section="detectors", name="base detector")
    if not has_base():
        yield line(state=State.OK, found="not installed: a project needs a view detector of its own")
        return
    try:
        read_trained(base_weights().parent)
    except AnnotatorError as error:
        yield line(state=State.FAILED, found=_first_line(error), remedy="install annotator again")
        return
    yield line(state=State.OK, found=f"installed; in a project without a view detector, it is used as {TITLE}")


def _checked(name: str, package: str, facts: Callable[[], str], missing: Line, broken: State = State.FAILED) -> Line:
    """The line of a package: `missing` if it is not installed, its facts, or why it cannot be loaded."""
    if find_spec(package.partition("-")[0]) is None:
        return missing
    try:
        return Line(section=SECTION, name=name, state=State.OK, found=facts())
    except MissingExtraError as error:
        return _broken(name, package, error.__cause__ or error, broken)
    except Exception as error:  # the type depends on the cause, e.g. a missing library or an old processor
        return _broken(name, package, error, broken)


def _broken(name: str, package: str, error: BaseException, state: State) -> Line:
    """Returns the line for a package that is missing or cannot be loaded, with what to install."""
    message = _first_line(error)
    if isinstance(error, ModuleNotFoundError) and error.name == package:
        return Line(section=SECTION, name=name, state=state, found="not installed", remedy=f"pip install {package}")
    library = LIBRARY.search(message)
    remedy = f"pip install --force-reinstall {package}"
    if library and library[0] in SYSTEM_LIBRARIES:
        remedy = f"install the system library: apt-get install {SYSTEM_LIBRARIES[library[0]]} (Debian, Ubuntu)"
    return Line(section=SECTION, name=name, state=state, found=f"cannot be loaded: {message}", remedy=remedy)


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def _version(module: str) -> str:
    """Returns the version of the distribution that contains a module."""
    # google.protobuf is in the distribution protobuf
    for name in _distributions().get(module, [module.rpartition(".")[2]]):
        try:
            return version(name)
        except PackageNotFoundError:
            continue
    return "of unknown version"


@lru_cache(maxsize=1)
def _distributions() -> Mapping[str, list[str]]:
    """Returns the distributions that contain each module; cached, because the search takes a quarter of a second."""
    return packages_distributions()
