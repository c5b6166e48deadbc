"""Each trained model is exported once, and again if the stored export is damaged or stale."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from threading import Barrier, local
from typing import Any

import numpy as np
import pytest

from annotator.detection import ultralytics_api
from annotator.detection.backends import choose
from annotator.detection.backends import export as export_module
from annotator.detection.backends.choose import open_network
from annotator.detection.backends.export import Export, export_key, find_export, keep_export
from annotator.detection.backends.network import ExportKind, Network, NetworkFacts
from annotator.detection.config import DetectorConfig
from annotator.detection.trained import TrainedModel
from annotator.types.errors import FormatError

EXPORT_ONCE = lru_cache(export_module.export)
PICTURE = np.random.default_rng(0).integers(0, 256, (1, 64, 96, 3), np.uint8)


def opened_onnx(weights: Path, digest: str = "digest") -> Network:
    config = DetectorConfig(image_size_px=96, device="cpu", backend="onnxruntime", threads=1)
    return open_network(weights, digest, config)


def exports_folder(tmp_path: Path) -> Path:
    return tmp_path / "cache" / "annotator" / "exports"


@pytest.fixture
def exports(tiny_model: TrainedModel, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """The exports that were requested. Only the first one is computed, as all tests here use the same weights."""
    requested: list[str] = []
    real = EXPORT_ONCE

    def counted(weights: Path, kind: Any) -> Any:
        requested.append(kind)
        return real(tiny_model.weights, kind)

    monkeypatch.setattr(export_module, "export", counted)
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
        return opened_onnx(own_weights, digest).predict([PICTURE])[0]

    first = answer()
    np.testing.assert_array_equal(answer(), first)
    assert len(exports) == 1
    (folder,) = exports_folder(tmp_path).iterdir()
    stored = {path.name: path.read_bytes() for path in folder.iterdir()}
    record = json.loads(stored["export.json"])
    damages = {
        "network.onnx": (stored["network.onnx"][:-1], b"", None),
        "export.json": (b"{}", json.dumps({**record, "key": "another"}).encode(), stored["export.json"][:50]),
    }
    expected = 1
    for name, contents in damages.items():
        for content in contents:
            (folder / name).unlink() if content is None else (folder / name).write_bytes(content)
            np.testing.assert_array_equal(answer(), first)
            expected += 1
            assert len(exports) == expected
            assert "exporting again" in caplog.text
            assert (folder / name).read_bytes() == stored[name]
    answer("other weights")
    monkeypatch.setattr(export_module, "REVISIONS", {"onnxruntime": export_module.REVISIONS["onnxruntime"] + 1})
    answer()
    assert len(exports) == expected + 2
    assert not [path for path in exports_folder(tmp_path).iterdir() if path.name.startswith(".")]


def test_an_export_beside_the_weights_is_never_used(own_weights: Path, exports: list[str], tmp_path: Path) -> None:
    """In a project that somebody else sent, it could be any network, and read other files."""
    opened_onnx(own_weights)
    (kept,) = exports_folder(tmp_path).iterdir()
    sent = own_weights.parent / f"{own_weights.stem}-onnxruntime-{kept.name.partition('-')[2][:12]}"
    shutil.move(kept, sent)
    opened_onnx(own_weights)
    assert len(exports) == 2
    assert {path.name for path in own_weights.parent.iterdir()} == {own_weights.name, sent.name}


def test_without_a_writable_cache_an_export_is_repeated(
    own_weights: Path, exports: list[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(out: Path, may_replace: Callable[[Path], bool]) -> Any:
        # Permissions of folders do not apply to the superuser, so the refusal is simulated.
        raise FormatError(out, "cannot be requested (Permission denied)")

    monkeypatch.setattr(export_module, "new_folder", refuse)
    for _ in range(2):
        opened_onnx(own_weights)
    assert len(exports) == 2
    assert "Permission denied" in caplog.text


def test_the_least_recently_used_exports_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(ultralytics_api, "MOST_KEPT", 2)
    export = Export(NetworkFacts(labels=("cat",), stride=32, end2end=False, edge_spread=False), {"network.onnx": b""})
    for number, key in enumerate("abc"):
        keep_export("onnxruntime", key, export)
        os.utime(exports_folder(tmp_path) / f"onnxruntime-{key}", (number, number))
        find_export("onnxruntime", "a")
    assert find_export("onnxruntime", "b") is None
    assert find_export("onnxruntime", "a") is not None


def test_only_one_of_several_workers_exports(
    own_weights: Path, exports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several conversions at once could need more memory than the machine has."""
    real, together = find_export, Barrier(3)
    first = local()

    def looked_at_once(kind: ExportKind, key: str) -> Export | None:
        cached = real(kind, key)
        if not hasattr(first, "looked"):
            first.looked = True
            together.wait(60)
        return cached

    monkeypatch.setattr(choose, "find_export", looked_at_once)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(opened_onnx, [own_weights] * 3))
    assert exports == ["onnxruntime"]


def test_two_processes_may_export_at_once(own_weights: Path, exports: list[str], tmp_path: Path) -> None:
    """The second process finds the export of the first one when it stores its own, and does not replace it."""
    opened_onnx(own_weights)
    (folder,) = exports_folder(tmp_path).iterdir()
    before = (folder / "export.json").stat().st_ino
    key = export_key("onnxruntime", "digest")
    cached = find_export("onnxruntime", key)
    assert cached is not None
    keep_export("onnxruntime", key, Export(cached.facts, cached.parts))
    assert (folder / "export.json").stat().st_ino == before
    assert len(list(exports_folder(tmp_path).iterdir())) == 1
