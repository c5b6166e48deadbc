"""Checks of installed packages: whether each can be loaded, and which devices it can use."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from importlib import import_module
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path

from annotator.detection.backends.choose import chosen
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.pretrained import TITLE, base_weights, has_base
from annotator.detection.trained import read_trained
from annotator.types import DetectorKind
from annotator.types.errors import AnnotatorError, DeviceError, MissingExtraError
from annotator.workflows.doctor.report import Line, State

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

    try:
        ultralytics_version = str(api().version)
    except AnnotatorError as error:
        if find_spec("ultralytics") is None:
            remedy = "pip install ultralytics-opencv-headless; without it, detectors cannot be trained or converted"
            yield Line(section=SECTION, name="ultralytics", state=State.FAILED, found="not installed", remedy=remedy)
        else:
            yield _broken("ultralytics", "ultralytics-opencv-headless", error, State.FAILED)
        return
    yield Line(section=SECTION, name="ultralytics", state=State.OK, found=ultralytics_version)
    weights = ", ".join(map(str, local_weights()))
    none = "none; the first training downloads them, or starts from random weights"
    yield Line(section=SECTION, name="published weights", state=State.OK, found=weights or none)


def openvino(_: Path) -> Iterator[Line]:
    """Checks whether OpenVINO can be loaded, and lists its devices."""
    from annotator.detection.backends.openvino_network import computes_bfloat16
    from annotator.detection.backends.openvino_network import openvino as load

    if find_spec("openvino") is None:
        yield _missing_openvino()
        return
    try:
        module = load()
        devices = ", ".join(module.Core().available_devices)
        half = "with bfloat16" if computes_bfloat16() else "without bfloat16"
    except AnnotatorError as error:
        yield _broken("OpenVINO", "openvino", error, State.WARNING)
        return
    facts = f"{module.get_version()}, devices {devices}; the processor {half}"
    yield Line(section=SECTION, name="OpenVINO", state=State.OK, found=facts)


def _missing_openvino() -> Line:
    """Returns the line for a missing OpenVINO: a warning on x86 processors only, where it is the fastest backend."""
    name = "OpenVINO"
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return Line(section=SECTION, name=name, state=State.OK, found="not installed; not used on this processor")
    remedy = "pip install openvino; without it, detectors take several times as long on the processor"
    return Line(section=SECTION, name=name, state=State.WARNING, found="not installed", remedy=remedy)


def onnxruntime(_: Path) -> Iterator[Line]:
    """Checks whether ONNX Runtime can be loaded, and lists its providers."""
    from annotator.detection.backends.onnx_network import onnxruntime as load

    if find_spec("onnxruntime") is None:
        yield Line(section=SECTION, name="ONNX Runtime", state=State.OK, found="not installed (extra onnx)")
        return
    try:
        module = load()
        facts = f"{module.__version__}, providers {', '.join(module.get_available_providers())}"
    except (MissingExtraError, OSError, AttributeError) as error:
        yield _broken("ONNX Runtime", "onnxruntime", error.__cause__ or error, State.WARNING)
        return
    yield Line(section=SECTION, name="ONNX Runtime", state=State.OK, found=facts)


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
    """Checks whether open3d, which needs the system's OpenGL, can be loaded and casts rays correctly."""
    import numpy as np

    from annotator.synthetic.render import RayScene

    if find_spec("open3d") is None:
        remedy = f"{REINSTALL}; without it `annotator generate` and `annotator demo` do not work"
        yield Line(section=SECTION, name="open3d", state=State.WARNING, found="not installed", remedy=remedy)
        return
    corners = np.array([[-1, -1, 2], [1, -1, 2], [0, 1, 2]], np.float32)
    try:
        scene = RayScene(corners, np.array([[0, 1, 2]], np.int32))
        hits = scene.first_hits(np.zeros((2, 3), np.float32), np.array([[0, 0, 1], [5, 0, 1]], np.float32))
    except Exception as error:  # the type depends on the cause, e.g. a missing library or an old processor
        yield _broken("open3d", "open3d", error, State.FAILED)
        return
    # hits are correct up to rounding in single precision
    if not abs(hits.t[0] - 2) < 1e-5 or hits.triangle.tolist() != [0, -1]:
        problem = f"{_version('open3d')}, wrong ray hits: {hits.t.tolist()}, triangles {hits.triangle.tolist()}"
        yield Line(section=SECTION, name="open3d", state=State.FAILED, found=problem, remedy=REINSTALL)
        return
    facts = f"{_version('open3d')}, loads with this system's OpenGL and casts rays"
    yield Line(section=SECTION, name="open3d", state=State.OK, found=facts)


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
    from annotator.recordings.kinect.connection import load_pyk4a

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
