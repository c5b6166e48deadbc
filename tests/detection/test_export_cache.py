"""Each trained model is exported once; what is kept is made anew where it cannot be trusted."""

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
    """Which exports were made; the work is done for the first one, as all tests here have the same weights."""
    made: list[str] = []
    real = EXPORT_ONCE

    def counted(weights: Path, kind: Any) -> Any:
        made.append(kind)
        return real(tiny_model.weights, kind)

    monkeypatch.setattr(export_module, "export", counted)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return made


def test_an_export_is_made_once_and_anew_where_it_is_damaged_or_stale(
    own_weights: Path, exports: list[str], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(digest: str = "a") -> np.ndarray:
        return opened(own_weights, digest).predict([PICTURE])[0]

    first = answer()
    np.testing.assert_array_equal(answer(), first)
    assert len(exports) == 1
    (folder,) = (path for path in own_weights.parent.iterdir() if path.is_dir())
    kept = {path.name: path.read_bytes() for path in folder.iterdir()}
    record = json.loads(kept["export.json"])
    damages = {
        "network.onnx": (kept["network.onnx"][:-1], b"", None),
        "export.json": (b"{}", json.dumps({**record, "key": "another"}).encode(), kept["export.json"][:50]),
    }
    wanted = 1
    for name, contents in damages.items():
        for content in contents:
            (folder / name).unlink() if content is None else (folder / name).write_bytes(content)
            np.testing.assert_array_equal(answer(), first)
            wanted += 1
            assert len(exports) == wanted
            assert "made anew" in caplog.text
            assert (folder / name).read_bytes() == kept[name]
    answer("other weights")
    monkeypatch.setattr(export_cache, "REVISIONS", {"onnxruntime": export_cache.REVISIONS["onnxruntime"] + 1})
    answer()
    assert len(exports) == wanted + 2
    assert not [path for path in own_weights.parent.iterdir() if path.name.startswith(".")]


def test_where_nothing_can_be_written_the_users_cache_keeps_it_or_nobody(
    own_weights: Path,
    exports: list[str],
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, closed = export_cache.new_folder, [own_weights.parent]

    def refuse(out: Path, may_replace: Callable[[Path], bool]) -> Any:
        # A superuser may write into folders that nobody may write into.
        if any(out.is_relative_to(folder) for folder in closed):
            raise FormatError(out, "cannot be made (Permission denied)")
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


def test_of_workers_that_start_together_one_exports(
    own_weights: Path, exports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each with torch and a network being converted would need more memory than there may be."""
    real, together = find_export, Barrier(3)
    first = local()

    def looked_at_once(weights: Path, kind: ExportKind, key: str) -> Export | None:
        found = real(weights, kind, key)
        if not hasattr(first, "looked"):
            first.looked = True
            together.wait(60)
        return found

    monkeypatch.setattr(choose, "find_export", looked_at_once)
    with ThreadPoolExecutor(3) as pool:
        list(pool.map(opened, [own_weights] * 3))
    assert exports == ["onnxruntime"]


def test_two_processes_may_export_at_once(own_weights: Path, exports: list[str]) -> None:
    """The second one finds the first one's when it has made its own, and leaves it as it is."""
    opened(own_weights)
    (folder,) = (path for path in own_weights.parent.iterdir() if path.is_dir())
    before = (folder / "export.json").stat().st_ino
    key = export_key("onnxruntime", "digest")
    found = find_export(own_weights, "onnxruntime", key)
    assert found is not None
    keep_export(own_weights, "onnxruntime", key, Export(found.facts, found.parts))
    assert (folder / "export.json").stat().st_ino == before
    assert len(list(own_weights.parent.iterdir())) == 2
