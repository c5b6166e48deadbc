"""The choice of the backend, its errors, and that no backend accesses the network."""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from threading import Barrier, local

import numpy as np
import pytest

from annotator.detection.backends import choose, openvino_network
from annotator.detection.backends import export as export_module
from annotator.detection.backends.choose import Network, open_network
from annotator.detection.backends.export import Export, find_export
from annotator.detection.config import Backend, DetectorConfig
from annotator.detection.trained import TrainedModel
from annotator.types.errors import ConfigError, DetectionError
from tests.detection.test_backends import make

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]


def test_auto_uses_the_fastest_backend_and_logs_it(
    tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    installed = {"openvino", "torch"}
    monkeypatch.setattr(choose, "find_spec", lambda name: name if name in installed else None)
    monkeypatch.setattr(choose, "has_cuda", lambda: False)
    caplog.set_level(logging.INFO, "annotator.detectors")
    for expected in ("openvino", "torch"):
        caplog.clear()
        detector = make(tiny_model.weights, device="auto")
        assert detector.backend == expected
        assert f"runs on {expected}" in caplog.text
        installed.discard(expected)
    installed.add("openvino")
    monkeypatch.setattr(choose, "has_cuda", lambda: True)
    assert choose._choices(DetectorConfig(image_size_px=96)) == ("torch",)
    assert choose._choices(DetectorConfig(image_size_px=96, device="cpu"))[0] == "openvino"


def test_auto_skips_backends_that_cannot_run_the_network(
    own_weights: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Fails:
        @staticmethod
        def convert_model(*_: object, **__: object) -> None:
            raise ValueError("unknown operation")

    monkeypatch.setattr(export_module, "openvino", Fails)
    monkeypatch.setattr(choose, "find_export", lambda _: None)
    assert make(own_weights).backend == "torch"
    assert "unknown operation" in caplog.text
    with pytest.raises(
        DetectionError, match=r"detector\.safetensors: cannot be converted for OpenVINO .*use --backend torch"
    ):
        make(own_weights, backend="openvino")


def test_a_missing_package_is_named(tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    monkeypatch.setattr(openvino_network, "_load", openvino_network._load.__wrapped__)
    with pytest.raises(DetectionError, match="pip install openvino"):
        make(tiny_model.weights, backend="openvino")


def test_other_devices_need_torch(tiny_model: TrainedModel) -> None:
    with pytest.raises(ConfigError, match="openvino runs on the processor, not on cuda:1"):
        make(tiny_model.weights, backend="openvino", device="cuda:1")


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


@pytest.mark.parametrize("backend", ["openvino", "fastest"])
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


EXPORT_ONCE = lru_cache(export_module.export)
PICTURE = np.random.default_rng(0).integers(0, 256, (1, 64, 96, 3), np.uint8)


def opened(weights: Path, digest: str = "digest") -> Network:
    config = DetectorConfig(image_size_px=96, device="cpu", backend="openvino", threads=1)
    return open_network(weights, digest, config)


def exports_folder(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "annotator" / "exports"


@pytest.fixture
def exports(tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """The exports that were requested. Only the first one is computed, as all tests here use the same weights."""
    requested: list[str] = []
    real = EXPORT_ONCE

    def counted(weights: Path) -> Export:
        requested.append("openvino")
        return real(tiny_model.weights)

    monkeypatch.setattr(choose, "export", counted)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return requested


def test_an_export_is_reused_unless_damaged_or_stale(
    own_weights: Path,
    exports: list[str],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def answer(digest: str = "a") -> np.ndarray:
        return opened(own_weights, digest).predict([PICTURE])[0]

    first = answer()
    np.testing.assert_array_equal(answer(), first)
    assert len(exports) == 1
    (file,) = exports_folder(tmp_path).iterdir()
    stored = file.read_bytes()
    flipped = bytearray(stored)
    flipped[-100] ^= 1
    for expected, content in enumerate((stored[:-1], b"", bytes(flipped), stored[:50]), 2):
        file.write_bytes(content)
        np.testing.assert_array_equal(answer(), first)
        assert len(exports) == expected
        assert "exporting again" in caplog.text
        np.testing.assert_array_equal(answer(), first)
        assert len(exports) == expected
    answer("other weights")
    monkeypatch.setattr(export_module, "REVISION", export_module.REVISION + 1)
    answer()
    assert len(exports) == expected + 2
    assert not [path for path in exports_folder(tmp_path).iterdir() if path.name.startswith(".")]


def test_an_export_beside_the_weights_is_never_used(own_weights: Path, exports: list[str], tmp_path: Path) -> None:
    """In a project that somebody else sent, it could be any network, and read other files."""
    opened(own_weights)
    (kept,) = exports_folder(tmp_path).iterdir()
    sent = own_weights.parent / f"{own_weights.stem}-openvino-{kept.name.partition('-')[2][:12]}"
    shutil.move(kept, sent)
    opened(own_weights)
    assert len(exports) == 2
    assert {path.name for path in own_weights.parent.iterdir()} == {own_weights.name, sent.name}


def test_only_one_of_several_workers_exports(
    own_weights: Path, exports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several conversions at once could need more memory than the machine has."""
    real, together = find_export, Barrier(3)
    first = local()

    def looked_at_once(key: str) -> Export | None:
        cached = real(key)
        if not hasattr(first, "looked"):
            first.looked = True
            together.wait(60)
        return cached

    monkeypatch.setattr(choose, "find_export", looked_at_once)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(opened, [own_weights] * 3))
    assert exports == ["openvino"]
