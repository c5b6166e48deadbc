"""The report of `annotator doctor`: facts, missing and broken packages, self-tests, crashes and hangs, and its JSON."""

from __future__ import annotations

import json
import math
import os
import re
import sys
import time
import tomllib
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec
from importlib.metadata import packages_distributions
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from annotator import __version__
from annotator.detection import pretrained, ultralytics_api
from annotator.detection.backends import agreement, choose
from annotator.detection.backends.agreement import Agreements
from annotator.detection.backends.network import Answer, Batch
from annotator.detection.backends.torch_network import TorchNetwork
from annotator.detection.pretrained import write_seeded_network
from annotator.detection.ultralytics_api import api, pick_device
from annotator.types.errors import DetectionError
from annotator.workflows.doctor import Line, Report, State, as_text, examine, facts, self_test
from annotator.workflows.doctor.examine import run_check
from annotator.workflows.doctor.report import shortened, without_home


def line(state: State, remedy: str = "", **figures: float) -> Line:
    return Line(section="machine", name=str(state), state=state, found="something", remedy=remedy, figures=figures)


def test_each_line_has_its_state_and_remedy() -> None:
    lines = (line(State.OK), line(State.WARNING, "mend it"), line(State.FAILED, "replace it"))
    text = list(as_text(Report(annotator_version="1.2.3", lines=lines)))
    assert text[0] == "annotator 1.2.3"
    assert [row.rsplit(": ", 1)[1] for row in text if "something" in row] == ["ok", "warning", "failed"]
    assert [row.split("-> ")[1] for row in text if "-> " in row] == ["mend it", "replace it"]
    assert text[-1] == "1 ok, 1 warning, 1 failed"


def test_the_json_reads_back_also_with_nan_and_infinity() -> None:
    report = Report(annotator_version="1", lines=(line(State.FAILED, value=math.nan, bound=math.inf),))
    text = report.model_dump_json()
    assert "null" not in text
    back = Report.model_validate_json(text)
    assert math.isnan(back.lines[0].figures["value"]) and back.lines[0].figures["bound"] == math.inf


def test_the_json_schema_is_unchanged() -> None:
    """Programs read it; raise `REPORT_VERSION` with every change."""
    report = json.loads(Report(annotator_version="1", lines=(line(State.OK, cores=2),)).model_dump_json())
    assert report == {
        "report_version": 1,
        "annotator_version": "1",
        "lines": [
            {
                "section": "machine",
                "name": "ok",
                "state": "ok",
                "found": "something",
                "remedy": "",
                "figures": {"cores": 2.0},
            }
        ],
    }


def test_the_home_folder_is_not_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    home, link = tmp_path / "ada", tmp_path / "link"
    home.mkdir()
    link.symlink_to(home)
    monkeypatch.setenv("HOME", str(link))
    shown = without_home(
        Line(section="s", name="n", state=State.OK, found=f"in {home}/a and {link}/b", remedy=f"see {home}/c")
    )
    assert (shown.found, shown.remedy) == ("in ~/a and ~/b", "see ~/c")
    assert shortened(str(home)) == "~"
    assert shortened(f"{home}line/a") == f"{home}line/a"
    monkeypatch.setenv("HOME", "/")
    assert shortened("/usr/lib") == "/usr/lib"


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
    found = lines(facts.machine, tmp_path / "not" / "there")
    assert __version__ in found["annotator"].found
    assert "3." in found["Python"].found
    assert found["processor"].figures["cores"] >= found["processor"].figures["usable_cores"] >= 1
    assert 0 < found["memory"].figures["free_bytes"] <= found["memory"].figures["total_bytes"]
    assert found["disk of projects"].figures["free_bytes"] > 0
    assert str(tmp_path / "not" / "there") in found["disk of projects"].found


def test_little_memory_or_disk_space_is_a_warning(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(facts.shutil, "disk_usage", lambda _: usage(10, 9, 1))
    monkeypatch.setattr(facts, "_memory_bytes", lambda: (2**30, None))
    found = lines(facts.machine, tmp_path)
    assert [found[name].state for name in ("memory", "disk of projects")] == [State.WARNING] * 2
    monkeypatch.setattr(facts, "_memory_bytes", lambda: (None, None))
    assert lines(facts.machine, tmp_path)["memory"].found == "unknown on this system"


def test_all_dependencies_and_extras_are_checked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    looked_for = {*facts.REQUIRED, "numba", "open3d", "ultralytics", "openvino"}
    names = {re.split(r"[<>=;\[ ]", text)[0].lower() for text in project["dependencies"]} - {"open3d"}
    brought_by = packages_distributions()
    found = {name.lower() for module in looked_for for name in brought_by.get(module, ())}
    assert names - found <= {"openvino"}  # optional on some processors
    extras = {name for name in project["optional-dependencies"] if name != "test"}
    assert set(facts.EXTRAS) == extras


def test_the_system_libraries_are_those_of_the_setup_script() -> None:
    text = (ROOT / "scripts" / "setup").read_text(encoding="utf-8")
    listed = re.search(r"^LIBRARIES=\((.*?)^\)", text, re.MULTILINE | re.DOTALL)
    assert listed
    assert dict(entry.split() for entry in re.findall(r'"(.*?)"', listed[1])) == facts.SYSTEM_LIBRARIES


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    hide(monkeypatch, "viser", "sqlalchemy")
    found = lines(facts.required)
    assert found["required"].state is State.FAILED
    assert found["required"].found == "missing: sqlalchemy, viser"
    assert "viser" not in found["versions"].found and "numpy 2" in found["versions"].found


@pytest.mark.parametrize(
    ("check", "module", "state"),
    [
        (facts.torch, "torch", State.FAILED),
        (facts.openvino, "openvino", State.WARNING),
        (facts.onnxruntime, "onnxruntime", State.OK),
        (facts.open3d, "open3d", State.WARNING),
        (facts.kinect, "pyk4a", None),
    ],
)
def test_a_package_that_is_not_installed_is_reported(
    monkeypatch: pytest.MonkeyPatch, check: Callable[[Path], Iterator[Line]], module: str, state: State | None
) -> None:
    hide(monkeypatch, module)
    monkeypatch.setattr(facts.platform, "machine", lambda: "x86_64")
    found = list(lines(check).values())
    assert [each.state for each in found] == ([] if state is None else [state])
    assert all("not installed" in each.found for each in found)


def test_a_missing_system_library_is_reported_with_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "open3d" / "__init__.py"
    broken.parent.mkdir()
    broken.write_text("raise OSError('libGL.so.1: cannot open shared object file: No such file or directory')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "open3d"]:
        monkeypatch.delitem(sys.modules, name)
    found = lines(facts.open3d)["open3d"]
    assert found.state is State.FAILED
    assert "libGL.so.1" in found.found
    assert "apt-get install libgl1 " in found.remedy


def test_numba_that_cannot_be_loaded_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: str) -> None:
        raise ImportError("Numba needs NumPy 2.3 or less. Got NumPy 9")

    monkeypatch.setattr(facts, "import_module", fail)
    found = lines(facts.numba)["numba"]
    assert (found.state, found.found) == (State.FAILED, "cannot be loaded: Numba needs NumPy 2.3 or less. Got NumPy 9")


def test_compiled_kernels_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    import numpy as np

    from annotator.geometry.kernels import points_in_box

    points_in_box(np.zeros((1, 3)), np.zeros(3), np.eye(3), np.ones(3))
    found = lines(facts.numba)["numba"]
    assert found.figures["kernels"] > 10
    assert 1 <= found.figures["compiled"] <= found.figures["kernels"]
    assert "__pycache__" in found.found
    monkeypatch.setattr(points_in_box, "_cache", SimpleNamespace(cache_path=None))
    assert lines(facts.numba)["numba"].figures["compiled"] == found.figures["compiled"] - 1


GPU = ultralytics_api.CudaDevice("cuda:0", "NVIDIA Something", "8.9", 8 * 2**30, 6 * 2**30)


def test_cuda_devices_and_their_errors_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ultralytics_api, "cuda_devices", lambda: [GPU])
    assert lines(facts.torch)["cuda:0"].found == ("NVIDIA Something, compute capability 8.9, 6.0 of 8.0 GiB free")
    monkeypatch.setattr(ultralytics_api, "cuda_devices", list)
    monkeypatch.setattr(choose, "driver_devices", lambda: 1)
    assert lines(facts.torch)["CUDA"].state is State.WARNING
    monkeypatch.setattr(choose, "driver_devices", lambda: 0)
    assert lines(facts.torch)["CUDA"].state is State.OK

    def fail() -> None:
        raise RuntimeError("CUDA error: out of memory\nmore")

    monkeypatch.setattr(ultralytics_api, "cuda_devices", fail)
    found = lines(facts.torch)["CUDA"]
    assert (found.state, found.found) == (State.FAILED, "CUDA error: out of memory")


def test_published_weights_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:

    monkeypatch.setattr(api(), "weights_dir", tmp_path / "theirs")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert lines(facts.ultralytics)["published weights"].found.startswith("none; ")
    for path in (tmp_path / "theirs" / "yolov8n.pt", tmp_path / "cache" / "annotator" / "weights" / "yolo11n.pt"):
        path.parent.mkdir(parents=True)
        path.touch()
    found = lines(facts.ultralytics)["published weights"].found
    assert "annotator/weights/yolo11n.pt, " in found and "theirs/yolov8n.pt" in found


def test_the_base_detector_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    assert "a project needs a view detector of its own" in lines(facts.base_detector)["base detector"].found
    (tmp_path / "detector.safetensors").write_bytes(b"weights")
    broken = lines(facts.base_detector)["base detector"]
    assert broken.state is State.FAILED and "model.json" in broken.found
    monkeypatch.setattr(facts, "read_trained", lambda _: None)
    found = lines(facts.base_detector)["base detector"]
    assert found.state is State.OK and found.found.endswith(pretrained.TITLE)


def test_a_choice_that_cannot_be_loaded_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise DetectionError("no torch")

    monkeypatch.setattr(choose, "find_spec", lambda _: None)
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    monkeypatch.setattr(ultralytics_api, "api", broken)
    found = lines(facts.choices)["image, auto"]
    assert found.state is State.FAILED
    assert "no torch" in found.found


def test_connected_kinects_are_counted_and_a_broken_sdk_is_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    library = ModuleType("pyk4a")
    library.__spec__ = ModuleSpec("pyk4a", None)
    library.connected_device_count = lambda: 1
    monkeypatch.setitem(sys.modules, "pyk4a", library)
    assert lines(facts.kinect)["Azure Kinect"].found == "1 connected"
    monkeypatch.delitem(sys.modules, "pyk4a")
    (tmp_path / "pyk4a.py").write_text("raise ImportError('libk4a.so.1.4 is missing')")
    monkeypatch.syspath_prepend(tmp_path)
    found = lines(facts.kinect)["Azure Kinect"]
    assert found.state is State.WARNING
    assert "libk4a.so.1.4 is missing" in found.found


def fine(projects: Path) -> Iterator[Line]:
    # libraries may print to standard output
    os.write(1, b"noise")
    yield Line(section="test", name="fine", state=State.OK, found=projects.name)


def raises(projects: Path) -> Iterator[Line]:
    yield from fine(projects)
    raise LookupError("a broken library\nand more")


def crashes(_: Path) -> Iterator[Line]:
    os.abort()
    yield


def hangs(_: Path) -> Iterator[Line]:
    time.sleep(3600)
    yield


def test_a_check_that_raises_keeps_its_earlier_lines(tmp_path: Path) -> None:
    found, lost = run_check("raises", raises, tmp_path)
    assert (found.name, found.state) == ("fine", State.OK)
    assert (lost.name, lost.state, lost.found) == ("raises", State.FAILED, "LookupError: a broken library")
    assert lost.remedy


def test_a_crash_affects_only_one_check(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    report = examine(tmp_path / "here", {"a": fine, "crashes": crashes, "b": fine})
    assert [(each.name, each.state.value) for each in report.lines] == [
        ("fine", "ok"),
        ("crashes", "failed"),
        ("fine", "ok"),
    ]
    assert "SIGABRT" in report.lines[1].found
    assert report.lines[0].found == "here"
    assert report.failed
    assert "noise" not in capfd.readouterr().out


def test_a_check_that_hangs_is_ended(tmp_path: Path) -> None:
    (lost,) = examine(tmp_path, {"hangs": hangs}, limit_s=1.0).lines
    assert (lost.name, lost.state, lost.found) == ("hangs", State.FAILED, "did not finish within 1 s")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("seeded") / "network.safetensors"
    write_seeded_network(path)
    return path


@pytest.fixture(scope="module")
def agreements(weights: Path) -> Agreements:
    return Agreements(weights, np.random.default_rng(0).integers(0, 256, (2, 64, 96, 3), np.uint8))


@dataclass
class Wrong:
    """Torch on the CPU with changed output, under another backend's name."""

    weights: Path
    change: Callable[[Answer], Answer]
    backend: str = "onnxruntime"
    device: str = "cpu"
    facts: Any = None
    network: TorchNetwork = field(init=False)

    def __post_init__(self) -> None:
        self.network = TorchNetwork(self.weights, pick_device("cpu"))

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        return [self.change(answer) for answer in self.network.predict(batches)]


def moved(by_px: float) -> Callable[[Answer], Answer]:
    return lambda answer: np.concatenate([answer[:, :4] + np.float32(by_px), answer[:, 4:]], axis=1)


def test_correct_output_agrees_and_wrong_output_does_not(agreements: Agreements) -> None:
    assert agreements.of(lambda path: Wrong(path, lambda answer: answer)).holds
    for wrong in (
        moved(0.5),
        lambda answer: answer[:, [0, 1, 2, 3, 5, 4, *range(6, answer.shape[1])]],  # classes in another order
        lambda answer: answer[:, [*range(answer.shape[1] - 4), -3, -4, -2, -1]],  # spreads in another order
        lambda answer: answer[::-1].copy(),  # pictures in another order
        lambda answer: np.where(np.arange(answer.shape[2]) == 0, np.float32(np.nan), answer),
    ):
        assert not agreements.of(lambda path, wrong=wrong: Wrong(path, wrong)).holds
    with pytest.raises(DetectionError, match="shape"):
        agreements.of(lambda path: Wrong(path, lambda answer: answer[:, :, 1:]))


@pytest.mark.parametrize(("name", "precision"), [("openvino-bf16", "bfloat16"), ("torch", "float16")])
def test_half_precision_has_a_larger_but_limited_tolerance(agreements: Agreements, name: str, precision: str) -> None:
    device = "cuda:0" if precision == "float16" else "cpu"
    small = agreements.of(lambda path: Wrong(path, moved(0.5), name, device))
    assert small.holds and small.reference == precision
    assert not agreements.of(lambda path: Wrong(path, moved(100.0), name, device)).holds


def test_a_wrong_or_broken_backend_is_a_failed_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fails(_: Path) -> None:
        raise DetectionError("no such operation")

    made = {
        "right": lambda path: Wrong(path, lambda answer: answer),
        "wrong": lambda path: Wrong(path, moved(0.5)),
        "broken": fails,
    }
    monkeypatch.setattr(agreement, "openers", lambda _: made)
    found = {line.name: line for line in self_test.backends(tmp_path)}
    assert {name: line.state.value for name, line in found.items()} == {
        "right": "ok",
        "wrong": "failed",
        "broken": "failed",
    }
    assert found["wrong"].figures["boxes_px"] == pytest.approx(0.5, rel=0.01)
    assert found["wrong"].figures["boxes_bound_px"] < 0.1
    assert "no such operation" in found["broken"].found


@pytest.mark.slow
def test_the_backends_of_this_machine_agree(tmp_path: Path) -> None:
    found = {line.name: line for line in self_test.backends(tmp_path)}
    assert set(found) >= {"openvino", "openvino-bf16", "onnxruntime"}
    assert all(line.state is State.OK for line in found.values()), found
    assert "boxes_px" in found["onnxruntime"].figures


def test_without_the_detectors_package_backends_are_not_tested(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from annotator.detection import pretrained

    def missing() -> None:
        raise DetectionError("no ultralytics")

    monkeypatch.setattr(pretrained, "api", missing)
    (line,) = self_test.backends(tmp_path)
    assert (line.state, line.found) == (State.WARNING, "not tested (no ultralytics)")
