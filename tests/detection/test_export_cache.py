"""Each trained model is exported once, and again if the stored export is damaged or stale."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from threading import Barrier, local
from typing import Any

import numpy as np
import pytest

from annotator.detection.backends import choose, export_cache
from annotator.detection.backends import export as export_module
from annotator.detection.backends.choose import open_network
from annotator.detection.backends.export_cache import Export, export_key, find_export, keep_export
from annotator.detection.backends.network import ExportKind, Network
from annotator.detection.config import DetectorConfig
from annotator.detection.trained import TrainedModel
from annotator.types.errors import FormatError

pytestmark = pytest.mark.slow

EXPORT_ONCE = lru_cache(export_module.export)
PICTURE = np.random.default_rng(0).integers(0, 256, (1, 64, 96, 3), np.uint8)


def opened(weights: Path, digest: str = "digest") -> Network:
    config = DetectorConfig(image_size_px=96, device="cpu", backend="onnxruntime", threads=1)
    return open_network(weights, digest, config)


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
    own_weights: Path, exports: list[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(digest: str = "a") -> np.ndarray:
        return opened(own_weights, digest).predict([PICTURE])[0]

    first = answer()
    np.testing.assert_array_equal(answer(), first)
    assert len(exports) == 1
    (folder,) = (path for path in own_weights.parent.iterdir() if path.is_dir())
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
    monkeypatch.setattr(export_cache, "REVISIONS", {"onnxruntime": export_cache.REVISIONS["onnxruntime"] + 1})
    answer()
    assert len(exports) == expected + 2
    assert not [path for path in own_weights.parent.iterdir() if path.name.startswith(".")]


def test_an_export_goes_to_the_users_cache_if_the_folder_is_not_writable(
    own_weights: Path,
    exports: list[str],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, closed = export_cache.new_folder, [own_weights.parent]

    def refuse(out: Path, may_replace: Callable[[Path], bool]) -> Any:
        # Permissions of folders do not apply to the superuser, so the refusal is simulated.
        if any(out.is_relative_to(folder) for folder in closed):
            raise FormatError(out, "cannot be requested (Permission denied)")
        return real(out, may_replace)

    monkeypatch.setattr(export_cache, "new_folder", refuse)
    for _ in range(2):
        opened(own_weights)
    assert exports == ["onnxruntime"]
    assert [path.name for path in (tmp_path / "cache" / "annotator" / "exports").iterdir()]
    assert caplog.text == ""
    closed.append(tmp_path)
    opened(own_weights, "others")
    assert len(exports) == 2
    assert "Permission denied" in caplog.text


def test_only_one_of_several_workers_exports(
    own_weights: Path, exports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Several conversions at once could need more memory than the machine has."""
    real, together = find_export, Barrier(3)
    first = local()

    def looked_at_once(weights: Path, kind: ExportKind, key: str) -> Export | None:
        cached = real(weights, kind, key)
        if not hasattr(first, "looked"):
            first.looked = True
            together.wait(60)
        return cached

    monkeypatch.setattr(choose, "find_export", looked_at_once)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(opened, [own_weights] * 3))
    assert exports == ["onnxruntime"]


def test_two_processes_may_export_at_once(own_weights: Path, exports: list[str]) -> None:
    """The second process finds the export of the first one when it stores its own, and does not replace it."""
    opened(own_weights)
    (folder,) = (path for path in own_weights.parent.iterdir() if path.is_dir())
    before = (folder / "export.json").stat().st_ino
    key = export_key("onnxruntime", "digest")
    cached = find_export(own_weights, "onnxruntime", key)
    assert cached is not None
    keep_export(own_weights, "onnxruntime", key, Export(cached.facts, cached.parts))
    assert (folder / "export.json").stat().st_ino == before
    assert len(list(own_weights.parent.iterdir())) == 2
