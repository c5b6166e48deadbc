"""The report of `annotator doctor`: facts, missing and broken packages, self-tests, crashes and hangs, and its JSON."""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from annotator import __version__
from annotator.detection import pretrained, ultralytics_api
from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends.network import Answer, Batch
from annotator.detection.backends.torch_network import TorchNetwork
from annotator.detection.config import DetectorConfig
from annotator.detection.ultralytics_api import api, pick_device
from annotator.types.errors import DetectionError
from annotator.workflows import doctor
from annotator.workflows.doctor import Line, Report, State, as_text, examine, line, without_home

ROOT = Path(__file__).resolve().parents[2]


def test_the_text_has_state_and_remedy_and_the_json_keeps_its_schema() -> None:
    """Programs read the JSON; raise `REPORT_VERSION` with every change."""
    found = (
        line("s", "a", "good"),
        line("s", "b", "poor", "mend it"),
        line("s", "c", "bad", "x", failed=True),
    )
    report = Report(annotator_version="1.2.3", lines=found)
    text = list(as_text(report))
    assert text[0] == "annotator 1.2.3" and text[-1] == "1 ok, 1 warning, 1 failed" and report.failed
    assert text[3:7] == ["  a  good: ok", "  b  poor: warning", "       -> mend it", "  c  bad: failed"]
    good = {"section": "s", "name": "a", "state": "ok", "found": "good", "remedy": ""}
    content = json.loads(report.model_dump_json())
    assert content == {"report_version": 2, "annotator_version": "1.2.3", "lines": [good, *content["lines"][1:]]}


def test_the_home_folder_is_not_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    home, link = tmp_path / "ada", tmp_path / "link"
    home.mkdir()
    link.symlink_to(home)
    monkeypatch.setenv("HOME", str(link))
    shown = without_home(line("s", "n", f"in {home}/a, {link}/b and {home}line/c", f"see {home}/c"))
    assert (shown.found, shown.remedy) == (f"in ~/a, ~/b and {home}line/c", "see ~/c")
    monkeypatch.setenv("HOME", "/")
    assert without_home(line("s", "n", "/usr/lib")).found == "/usr/lib"


def lines(check: Callable[[Path], Iterator[Line]], projects: Path = Path("projects")) -> dict[str, Line]:
    found = list(check(projects))
    assert len({each.name for each in found}) == len(found)
    assert all(each.remedy for each in found if each.state is not State.OK)
    return {each.name: each for each in found}


def test_the_machine_lines_have_version_cores_memory_and_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = lines(doctor.machine, tmp_path / "not" / "there")
    assert __version__ in found["annotator"].found and "3." in found["Python"].found
    assert "of them for this process" in found["processor"].found
    total, free = doctor._memory_bytes()
    assert 0 < free <= total and f"{total / 2**30:.1f} GiB, " in found["memory"].found
    assert str(tmp_path / "not" / "there") in found["disk of projects"].found
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: usage(10, 9, 1))
    monkeypatch.setattr(doctor, "_memory_bytes", lambda: (2**30, 2**20))
    found = lines(doctor.machine, tmp_path)
    assert [found[name].state for name in ("memory", "disk of projects")] == [State.WARNING] * 2


def test_the_system_libraries_are_those_of_the_setup_script() -> None:
    text = (ROOT / "scripts" / "setup").read_text(encoding="utf-8")
    listed = re.search(r"^LIBRARIES=\((.*?)^\)", text, re.MULTILINE | re.DOTALL)
    assert listed
    assert dict(entry.split() for entry in re.findall(r'"(.*?)"', listed[1])) == doctor.SYSTEM_LIBRARIES


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = ["numpy>=2.0", "viser[a]>=1", "open3d>=0.19; sys_platform == 'linux'", "no-such>=1; extra == 'ros'"]
    monkeypatch.setattr(doctor, "requires", lambda _: [*needs, "nothing-like-it>=3", "pytest; extra == 'test'"])
    found = lines(doctor.installed)
    assert list(found) == ["required", "versions", "ros"]
    assert (found["required"].state, found["required"].found) == (State.FAILED, "missing: nothing-like-it")
    assert re.fullmatch(r"numpy 2\S+, viser \S+", found["versions"].found)
    assert (found["ros"].state, found["ros"].found) == (State.OK, 'not installed: pip install "rcv-annotator[ros]"')
    monkeypatch.undo()
    monkeypatch.setattr(doctor, "DISTRIBUTION", "no-such-thing")
    assert lines(doctor.installed)["required"].state is State.WARNING


@pytest.mark.parametrize(
    ("check", "module", "state"),
    [
        (doctor.torch, "torch", State.FAILED),
        (doctor.openvino, "openvino", State.WARNING),
    ],
)
def test_a_package_that_is_not_installed_is_reported(
    monkeypatch: pytest.MonkeyPatch, check: Callable[[Path], Iterator[Line]], module: str, state: State
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(doctor.platform, "machine", lambda: "x86_64")
    (found,) = lines(check).values()
    assert found.state is state and "not installed" in found.found


def test_a_missing_system_library_is_reported_with_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / "open3d" / "__init__.py"
    broken.parent.mkdir()
    broken.write_text("raise OSError('libGL.so.1: cannot open shared object file: No such file or directory')")
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.partition(".")[0] == "open3d"]:
        monkeypatch.delitem(sys.modules, name)
    found = lines(doctor.open3d)["open3d"]
    assert found.state is State.WARNING and "libGL.so.1" in found.found
    assert "apt-get install libgl1 " in found.remedy


GPU = ultralytics_api.CudaDevice("cuda:0", "NVIDIA Something, compute capability 8.9", 8 * 2**30, 6 * 2**30)


def test_cuda_devices_and_their_errors_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ultralytics_api, "cuda_devices", lambda: [GPU])
    assert lines(doctor.torch)["cuda:0"].found == ("NVIDIA Something, compute capability 8.9, 6.0 of 8.0 GiB free")
    monkeypatch.setattr(ultralytics_api, "cuda_devices", list)
    for drivers, state in ((1, State.WARNING), (0, State.OK)):
        monkeypatch.setattr(choose, "driver_devices", lambda drivers=drivers: drivers)
        assert lines(doctor.torch)["CUDA"].state is state

    def fail() -> None:
        raise RuntimeError("CUDA error: out of memory\nmore")

    monkeypatch.setattr(ultralytics_api, "cuda_devices", fail)
    found = lines(doctor.torch)["CUDA"]
    assert (found.state, found.found) == (State.FAILED, "CUDA error: out of memory")


def test_published_weights_and_the_base_detector_are_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(api(), "weights_dir", tmp_path / "theirs")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert lines(doctor.ultralytics)["published weights"].found.startswith("none; ")
    for path in (tmp_path / "theirs" / "yolov8n.pt", tmp_path / "cache" / "annotator" / "weights" / "yolo11n.pt"):
        path.parent.mkdir(parents=True)
        path.touch()
    found = lines(doctor.ultralytics)["published weights"].found
    assert "annotator/weights/yolo11n.pt, " in found and "theirs/yolov8n.pt" in found
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    assert "a project needs a view detector of its own" in lines(doctor.base_detector)["base detector"].found
    (tmp_path / "detector.safetensors").write_bytes(b"weights")
    broken = lines(doctor.base_detector)["base detector"]
    assert broken.state is State.FAILED and "model.json" in broken.found


def fine(projects: Path) -> Iterator[Line]:
    # libraries may print to standard output
    os.write(1, b"noise")
    yield line("test", "fine", projects.name)


def raises(projects: Path) -> Iterator[Line]:
    yield from fine(projects)
    raise LookupError("a broken library\nand more")


def crashes(_: Path) -> Iterator[Line]:
    os.abort()
    yield


def hangs(_: Path) -> Iterator[Line]:
    time.sleep(3600)
    yield


def test_a_check_that_fails_or_crashes_costs_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    report = examine(tmp_path / "here", (raises, crashes, fine))
    assert [(each.name, each.state.value, each.found) for each in report.lines] == [
        ("fine", "ok", "here"),
        ("fine", "ok", "here"),
        ("raises", "failed", "LookupError: a broken library"),
        ("crashes", "failed", "crashed (SIGABRT)"),
    ]
    assert report.lines[2].remedy and "noise" not in capfd.readouterr().out


def test_a_check_that_hangs_is_ended(tmp_path: Path) -> None:
    (lost,) = examine(tmp_path, (hangs,), limit_s=1.0).lines
    assert (lost.name, lost.state, lost.found) == ("hangs", State.FAILED, "did not finish within 1 s")


@dataclass
class Wrong:
    """Torch on the CPU, whose output a GPU's name changes."""

    network: TorchNetwork
    change: Callable[[Answer], Answer]

    def predict(self, batches: Sequence[Batch]) -> list[Answer]:
        return [self.change(answer) for answer in self.network.predict(batches)]


def test_wrong_output_and_a_broken_backend_are_failed_lines(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Within its rounding, single precision is right; half precision on a GPU is allowed more, but not everything."""
    changes: dict[str, Callable[[Answer], Answer]] = {
        "openvino": lambda answer: answer,
        "a little": lambda answer: answer + np.float32(0.01) * (np.arange(answer.shape[1]) < 4)[:, None],
        "moved": lambda answer: answer + np.float32(5) * (np.arange(answer.shape[1]) < 4)[:, None],
        "classes": lambda answer: answer[:, [0, 1, 2, 3, 5, 4, *range(6, answer.shape[1])]],
        "spreads": lambda answer: answer[:, [*range(answer.shape[1] - 4), -3, -4, -2, -1]],
        "pictures": lambda answer: answer[::-1].copy(),
        "nan": lambda answer: np.where(np.arange(answer.shape[2]) == 0, np.float32(np.nan), answer),
        "shape": lambda answer: answer[:, :, 1:],
    }

    def opened(weights: Path, digest: str, config: DetectorConfig) -> TorchNetwork | Wrong:
        network = TorchNetwork(weights, pick_device("cpu"))
        if config.device == "no such":
            raise DetectionError("no such operation")
        name = config.device if config.backend == "torch" else "openvino"
        return network if name == "cpu" else Wrong(network, changes[name])

    gpus = [ultralytics_api.CudaDevice(name, "", 0, 0) for name in (*changes, "no such") if name != "openvino"]
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(doctor, "open_network", opened)
    monkeypatch.setattr(ultralytics_api, "cuda_devices", lambda: gpus)
    monkeypatch.setattr(openvino_network, "computes_bfloat16", lambda: False)
    found = lines(doctor.backends, tmp_path)
    assert [name for name, each in found.items() if each.state is State.OK] == [
        *("openvino", "openvino-bf16", "torch, a little")
    ]
    assert "by 5 px (boxes)" in found["torch, moved"].found
    assert "no such operation" in found["torch, no such"].found
    monkeypatch.setitem(changes, "openvino", lambda answer: answer + np.float32(0.1))

    def broken() -> bool:
        raise DetectionError("OpenVINO cannot be loaded")

    monkeypatch.setattr(openvino_network, "computes_bfloat16", broken)
    found = lines(doctor.backends, tmp_path)
    assert found["openvino"].state is found["openvino-bf16"].state is State.FAILED
    assert found["torch, a little"].state is State.OK


@pytest.mark.slow
def test_the_backends_of_this_machine_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = lines(doctor.backends, tmp_path)
    assert set(found) >= {"openvino", "openvino-bf16"}
    assert all(each.state is State.OK for each in found.values()), found
