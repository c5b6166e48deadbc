"""The choice of the backend, its errors, and that no backend accesses the network."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends import export as export_module
from annotator.detection.backends.network import side_by_side, usable_cores
from annotator.detection.backends.torch_network import TorchNetwork
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.trained import TrainedModel
from annotator.detection.ultralytics_api import api, pick_device
from annotator.detection.yolo import YoloDetector
from annotator.types.errors import AnnotatorError, ConfigError, DetectionError, MissingExtraError

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
EXPORTED: tuple[Backend, Backend] = ("openvino", "onnxruntime")


def make(weights: Path, **settings: Any) -> YoloDetector:
    return YoloDetector(weights, DetectorConfig(**{"image_size_px": 96, "device": "cpu", **settings}))


def test_auto_uses_the_fastest_backend_and_logs_it(
    tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    installed = {"openvino", "onnxruntime", "onnx", "torch"}
    monkeypatch.setattr(choose, "find_spec", lambda name: name if name in installed else None)
    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    caplog.set_level(logging.INFO, "annotator.detectors")
    for expected in ("openvino", "onnxruntime", "torch"):
        caplog.clear()
        detector = make(tiny_model.weights, device="auto")
        assert detector.backend == expected
        assert f"runs on {expected}" in caplog.text
        installed.discard(expected)
    installed.add("openvino")
    monkeypatch.setattr(choose.platform, "machine", lambda: "arm64")
    assert make(tiny_model.weights).backend == "torch"
    monkeypatch.setattr(choose.platform, "machine", lambda: "AMD64")
    monkeypatch.setattr(choose, "has_cuda", lambda: True)
    assert choose._choices(DetectorConfig(image_size_px=96)) == ("torch",)
    assert choose._choices(DetectorConfig(image_size_px=96, device="cpu"))[0] == "openvino"


def test_auto_skips_backends_that_cannot_run_the_network(
    own_weights: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("unknown operation")

    monkeypatch.setattr(choose.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(export_module, "_WRITERS", dict.fromkeys(EXPORTED, fail))
    assert make(own_weights).backend == "torch"
    assert "unknown operation" in caplog.text
    with pytest.raises(
        DetectionError, match=r"detector\.safetensors: cannot be converted for openvino .*use --backend torch"
    ):
        make(own_weights, backend="openvino")


@pytest.mark.parametrize(
    ("backend", "missing", "error", "message"),
    [
        ("openvino", "openvino", DetectionError, "pip install openvino"),
        ("onnxruntime", "onnxruntime", MissingExtraError, r"rcv-annotator\[onnx\]"),
    ],
)
def test_a_missing_package_is_named(
    tiny_model: TrainedModel,
    monkeypatch: pytest.MonkeyPatch,
    backend: Backend,
    missing: str,
    error: type[AnnotatorError],
    message: str,
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr(openvino_network, "_load", openvino_network._load.__wrapped__)
    monkeypatch.setattr(choose, "find_spec", lambda name: None if name == missing else name)
    with pytest.raises(error, match=message):
        make(tiny_model.weights, backend=backend)


def test_other_devices_need_torch(tiny_model: TrainedModel) -> None:
    with pytest.raises(ConfigError, match="openvino runs on the processor, not on cuda:1"):
        make(tiny_model.weights, backend="openvino", device="cuda:1")


@pytest.mark.parametrize("backend", ["torch", *EXPORTED])
def test_missing_or_damaged_weights(tmp_path: Path, backend: Backend) -> None:
    with pytest.raises(DetectionError, match=r"none\.pt: no such weights file; train"):
        make(tmp_path / "none.pt", backend=backend)
    (tmp_path / "bad.pt").write_bytes(b"weights")
    with pytest.raises(DetectionError, match=r"bad\.pt: cannot be read as detector weights"):
        make(tmp_path / "bad.pt", backend=backend)


def test_thread_numbers_are_used_and_restored(tiny_model: TrainedModel) -> None:
    torch = api().torch
    before = torch.get_num_threads()
    network = TorchNetwork(tiny_model.weights, pick_device("cpu"), threads=before + 1)
    seen: list[int] = []
    network._run.register_forward_hook(lambda *_: seen.append(torch.get_num_threads()))
    network.predict([np.zeros((1, 64, 96, 3), np.uint8)])
    assert seen == [before + 1]
    assert torch.get_num_threads() == before
    assert 1 <= usable_cores() <= (os.cpu_count() or 1)
    assert [side_by_side(n, 2) for n in (1, 2, 24)] == [False, True, True]
    assert [side_by_side(n, 16) for n in (2, 5, 24)] == [False, True, True]
    assert not side_by_side(24, 1)


QUIET = """
import json, socket, sys
asked = []
def refuse(*args, **kwargs):
    asked.append(str(args))
    raise OSError("no network in this test")
socket.getaddrinfo = socket.socket.connect = socket.create_connection = refuse
from pathlib import Path
import numpy as np
from annotator.detection.config import DetectorConfig
from annotator.detection.yolo import YoloDetector
detector = YoloDetector(Path(sys.argv[1]), DetectorConfig(image_size_px=96, backend=sys.argv[2], threads=2))
class Picture:
    rgb = np.zeros((96, 96, 3), np.uint8)
class Narrow:
    rgb = np.zeros((96, 40, 3), np.uint8)
detector.detect([Picture(), Narrow(), Picture()])
loaded = [name for name in ("torch", "ultralytics", "openvino_telemetry") if sys.modules.get(name)]
print(json.dumps({"asked": asked, "loaded": loaded, "backend": detector.backend}))
"""


@pytest.mark.parametrize("backend", [*EXPORTED, "fastest"])
def test_a_stored_export_runs_without_torch_and_network_access(
    tiny_model: TrainedModel, tmp_path: Path, backend: Backend
) -> None:
    """Detects on two image sizes at once in a fresh process, where OpenVINO's bindings once deadlocked."""
    make(tiny_model.weights, backend=backend)
    home = tmp_path / "home"
    home.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    done = subprocess.run(
        [sys.executable, "-c", QUIET, str(tiny_model.weights), backend],
        cwd=home,
        env=environment | {"HOME": str(home), "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    runs = make(tiny_model.weights, backend=backend).backend
    assert json.loads(done.stdout) == {"asked": [], "loaded": [], "backend": runs}
    assert list(home.iterdir()) == []
