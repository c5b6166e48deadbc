"""The report about the machine and its packages, also with missing or broken packages."""

from __future__ import annotations

import re
import sys
import tomllib
from collections import namedtuple
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from importlib.metadata import packages_distributions
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from annotator import __version__
from annotator.detection import pretrained
from annotator.detection import ultralytics_api as facts
from annotator.detection.backends import choose
from annotator.types.errors import DetectionError
from annotator.workflows.doctor import Line, State, machine, packages

ROOT = Path(__file__).resolve().parents[3]


def lines(check: Callable[[Path], Iterator[Line]], projects: Path = Path("projects")) -> dict[str, Line]:
    found = list(check(projects))
    assert len({each.name for each in found}) == len(found)
    assert all(each.remedy for each in found if each.state is not State.OK)
    return {each.name: each for each in found}


def hide(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """Makes imports of these packages fail as if they were not installed."""
    for name in names:
        monkeypatch.setitem(sys.modules, name, None)


def test_the_machine_lines_have_version_cores_memory_and_disk(tmp_path: Path) -> None:
    found = lines(machine.machine, tmp_path / "not" / "there")
    assert __version__ in found["annotator"].found
    assert "3." in found["Python"].found
    assert found["processor"].figures["cores"] >= found["processor"].figures["usable_cores"] >= 1
    assert 0 < found["memory"].figures["free_bytes"] <= found["memory"].figures["total_bytes"]
    assert found["disk of projects"].figures["free_bytes"] > 0
    assert str(tmp_path / "not" / "there") in found["disk of projects"].found


def test_little_memory_or_disk_space_is_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(machine.shutil, "disk_usage", lambda _: usage(10, 9, 1))
    monkeypatch.setattr(machine, "_memory_bytes", lambda: (2**30, None))
    found = lines(machine.machine, tmp_path)
    assert [found[name].state for name in ("memory", "disk of projects")] == [State.WARNING] * 2
    monkeypatch.setattr(machine, "_memory_bytes", lambda: (None, None))
    assert lines(machine.machine, tmp_path)["memory"].found == "unknown on this system"


def test_all_dependencies_and_extras_are_checked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    looked_for = {*packages.REQUIRED, "numba", "open3d", "ultralytics", "openvino"}
    names = {re.split(r"[<>=;\[ ]", text)[0].lower() for text in project["dependencies"]} - {"open3d"}
    brought_by = packages_distributions()
    found = {name.lower() for module in looked_for for name in brought_by.get(module, ())}
    assert names - found <= {"openvino"}  # optional on some processors
    extras = {name for name in project["optional-dependencies"] if name != "test"}
    assert set(packages.EXTRAS) == extras


def test_the_system_libraries_are_those_of_the_setup_script() -> None:
    text = (ROOT / "scripts" / "setup").read_text(encoding="utf-8")
    listed = re.search(r"^LIBRARIES=\((.*?)^\)", text, re.MULTILINE | re.DOTALL)
    assert listed
    assert dict(entry.split() for entry in re.findall(r'"(.*?)"', listed[1])) == packages.SYSTEM_LIBRARIES


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "viser", "sqlalchemy")
    found = lines(packages.required)
    assert found["required"].state is State.FAILED
    assert found["required"].found == "missing: sqlalchemy, viser"
    assert "viser" not in found["versions"].found and "numpy 2" in found["versions"].found


@pytest.mark.parametrize(
    ("check", "module", "state"),
    [
        (packages.torch, "torch", State.FAILED),
        (packages.openvino, "openvino", State.WARNING),
        (packages.onnxruntime, "onnxruntime", State.OK),
        (packages.open3d, "open3d", State.WARNING),
        (packages.kinect, "pyk4a", None),
    ],
)
def test_a_package_that_is_not_installed_is_reported(
    monkeypatch: pytest.MonkeyPatch, check: Callable[[Path], Iterator[Line]], module: str, state: State | None
) -> None:
    hide(monkeypatch, module)
    monkeypatch.setattr(packages.platform, "machine", lambda: "x86_64")
    found = list(lines(check).values())
    assert [each.state for each in found] == ([] if state is None else [state])
    assert all("not installed" in each.found for each in found)


def test_missing_openvino_is_no_problem_on_other_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "openvino")
    monkeypatch.setattr(packages.platform, "machine", lambda: "arm64")
    assert lines(packages.openvino)["OpenVINO"].state is State.OK


def test_a_missing_system_library_is_reported_with_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "open3d" / "__init__.py"
    broken.parent.mkdir()
    broken.write_text("raise OSError('libGL.so.1: cannot open shared object file: No such file or directory')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "open3d"]:
        monkeypatch.delitem(sys.modules, name)
    found = lines(packages.open3d)["open3d"]
    assert found.state is State.FAILED
    assert "libGL.so.1" in found.found
    assert "apt-get install libgl1 " in found.remedy


def test_numba_that_cannot_be_loaded_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: str) -> None:
        raise ImportError("Numba needs NumPy 2.3 or less. Got NumPy 9")

    monkeypatch.setattr(packages, "import_module", fail)
    found = lines(packages.numba)["numba"]
    assert (found.state, found.found) == (State.FAILED, "cannot be loaded: Numba needs NumPy 2.3 or less. Got NumPy 9")


def test_compiled_kernels_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    import numpy as np

    from annotator.geometry.kernels import points_in_box

    points_in_box(np.zeros((1, 3)), np.zeros(3), np.eye(3), np.ones(3))
    found = lines(packages.numba)["numba"]
    assert found.figures["kernels"] > 10
    assert 1 <= found.figures["compiled"] <= found.figures["kernels"]
    assert "__pycache__" in found.found
    monkeypatch.setattr(points_in_box, "_cache", SimpleNamespace(cache_path=None))
    assert lines(packages.numba)["numba"].figures["compiled"] == found.figures["compiled"] - 1


GPU = facts.CudaDevice("cuda:0", "NVIDIA Something", "8.9", 8 * 2**30, 6 * 2**30)


def test_cuda_devices_and_their_errors_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts, "cuda_devices", lambda: [GPU])
    assert lines(packages.torch)["cuda:0"].found == ("NVIDIA Something, compute capability 8.9, 6.0 of 8.0 GiB free")
    monkeypatch.setattr(facts, "cuda_devices", list)
    monkeypatch.setattr(choose, "driver_devices", lambda: 1)
    assert lines(packages.torch)["CUDA"].state is State.WARNING
    monkeypatch.setattr(choose, "driver_devices", lambda: 0)
    assert lines(packages.torch)["CUDA"].state is State.OK

    def fail() -> None:
        raise RuntimeError("CUDA error: out of memory\nmore")

    monkeypatch.setattr(facts, "cuda_devices", fail)
    found = lines(packages.torch)["CUDA"]
    assert (found.state, found.found) == (State.FAILED, "CUDA error: out of memory")


def test_published_weights_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from annotator.detection.ultralytics_api import api

    monkeypatch.setattr(api(), "weights_dir", tmp_path / "theirs")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert lines(packages.ultralytics)["published weights"].found.startswith("none; ")
    for path in (tmp_path / "theirs" / "yolov8n.pt", tmp_path / "cache" / "annotator" / "weights" / "yolo11n.pt"):
        path.parent.mkdir(parents=True)
        path.touch()
    found = lines(packages.ultralytics)["published weights"].found
    assert "annotator/weights/yolo11n.pt, " in found and "theirs/yolov8n.pt" in found


def test_the_choice_of_a_backend_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    from annotator.detection.backends import onnx_network, openvino_network

    installed = {"openvino", "onnxruntime", "onnx"}
    monkeypatch.setattr(choose, "find_spec", lambda name: name if name in installed else None)
    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    monkeypatch.setattr(openvino_network, "openvino", lambda: None)
    monkeypatch.setattr(onnx_network, "onnxruntime", lambda: None)
    monkeypatch.setattr(openvino_network, "computes_bfloat16", lambda: True)
    found = lines(packages.choices)
    assert set(found) == {"image, auto", "view, auto", "image, fastest", "view, fastest"}
    assert found["view, auto"].found.startswith("openvino (no CUDA device")
    assert found["view, fastest"].found.startswith("openvino-bf16 (")
    monkeypatch.setattr(openvino_network, "computes_bfloat16", lambda: False)
    assert lines(packages.choices)["image, fastest"].found.startswith("openvino (")

    def broken() -> None:
        raise DetectionError("OpenVINO cannot be loaded")

    monkeypatch.setattr(openvino_network, "openvino", broken)
    skipped = lines(packages.choices)["image, auto"].found
    assert skipped.startswith("onnxruntime (") and "OpenVINO cannot be loaded" in skipped
    installed.clear()
    assert lines(packages.choices)["image, auto"].found.startswith("torch (")
    monkeypatch.setattr(choose, "has_cuda", lambda: True)
    assert lines(packages.choices)["image, auto"].found == "torch (there is a CUDA device)"


def test_the_base_detector_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    assert "a project needs a view detector of its own" in lines(packages.base_detector)["base detector"].found
    (tmp_path / "detector.safetensors").write_bytes(b"weights")
    broken = lines(packages.base_detector)["base detector"]
    assert broken.state is State.FAILED and "model.json" in broken.found
    monkeypatch.setattr(packages, "read_trained", lambda _: None)
    found = lines(packages.base_detector)["base detector"]
    assert found.state is State.OK and found.found.endswith(pretrained.TITLE)


def test_a_choice_that_cannot_be_loaded_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    from annotator.detection import ultralytics_api

    def broken() -> None:
        raise DetectionError("no torch")

    monkeypatch.setattr(choose, "find_spec", lambda _: None)
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    monkeypatch.setattr(ultralytics_api, "api", broken)
    found = lines(packages.choices)["image, auto"]
    assert found.state is State.FAILED
    assert "no torch" in found.found


def test_connected_kinects_are_counted_and_a_broken_sdk_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    library = ModuleType("pyk4a")
    library.__spec__ = ModuleSpec("pyk4a", None)
    library.connected_device_count = lambda: 1
    monkeypatch.setitem(sys.modules, "pyk4a", library)
    assert lines(packages.kinect)["Azure Kinect"].found == "1 connected"
    monkeypatch.delitem(sys.modules, "pyk4a")
    (tmp_path / "pyk4a.py").write_text("raise ImportError('libk4a.so.1.4 is missing')")
    monkeypatch.syspath_prepend(tmp_path)
    found = lines(packages.kinect)["Azure Kinect"]
    assert found.state is State.WARNING
    assert "libk4a.so.1.4 is missing" in found.found
