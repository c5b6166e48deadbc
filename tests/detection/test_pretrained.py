"""Initial weights of a training run; no test here accesses the network."""

from __future__ import annotations

import hashlib
import json
import threading
from pathlib import Path
from typing import Any

import pytest

import annotator
from annotator.detection import pretrained
from annotator.detection.config import TrainingConfig
from annotator.detection.pretrained import check_start, find_starting_point
from annotator.detection.trained import read_trained
from annotator.detection.ultralytics_api import api
from annotator.rcv.config import AGNOSTIC_LABELS
from annotator.types.errors import ConfigError


@pytest.fixture
def downloads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """An empty cache, and a downloader that fails and records its requests."""
    asked: list[str] = []

    def fail(file: str, **_: Any) -> str:
        if Path(file).is_file():  # like ultralytics' downloader, which is called for every file that is loaded
            return file
        asked.append(file)
        raise ConnectionError("no route to host")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(api().downloads, "attempt_download_asset", fail)
    monkeypatch.setattr(api(), "weights_dir", tmp_path / "weights")
    monkeypatch.setattr(api(), "user_offline", False)
    return asked


def test_without_network_weights_are_random_with_a_note(downloads: list[str]) -> None:
    start = find_starting_point(TrainingConfig(model="yolo11n"))
    assert (start.weights, start.pretrained) == (None, False)
    assert "random weights" in start.note
    assert "no route to host" in start.note
    assert len(downloads) == 1


def test_a_download_times_out(downloads: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    answer = threading.Event()
    monkeypatch.setattr(api().downloads, "attempt_download_asset", lambda *_, **__: answer.wait())
    monkeypatch.setattr(pretrained, "DOWNLOAD_TIMEOUT_S", 0.2)
    start = find_starting_point(TrainingConfig())
    answer.set()
    assert not start.pretrained
    assert "no answer" in start.note


def test_downloaded_weights_are_used(downloads: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fetch(file: str, **_: Any) -> str:
        Path(file).write_bytes(b"weights")
        return file

    monkeypatch.setattr(api().downloads, "attempt_download_asset", fetch)
    start = find_starting_point(TrainingConfig(model="yolov8n"))
    assert start.pretrained
    assert start.weights == tmp_path / "cache" / "annotator" / "weights" / "yolov8n.pt"
    assert "downloaded" in start.note


def test_weights_from_a_file(downloads: list[str], tmp_path: Path) -> None:
    own = tmp_path / "own.pt"
    with pytest.raises(ConfigError, match=r"own\.pt"):
        find_starting_point(TrainingConfig(pretrained=own))
    own.write_bytes(b"weights")
    assert find_starting_point(TrainingConfig(pretrained=own)).weights == own
    assert downloads == []


def save_model(path: Path, name: str) -> Path:
    """A weights file of an untrained model, in the format of ultralytics."""
    from ultralytics.nn.tasks import DetectionModel, SegmentationModel

    kind = SegmentationModel if name.endswith("-seg") else DetectionModel
    path.parent.mkdir(parents=True, exist_ok=True)
    api().torch.save({"model": kind(f"{name}.yaml", verbose=False)}, path)
    return path


def test_initial_weights_are_checked_without_training_or_download(downloads: list[str], tmp_path: Path) -> None:
    check_start(TrainingConfig())
    check_start(TrainingConfig(pretrained="never"))
    check_start(TrainingConfig(pretrained=save_model(tmp_path / "own.pt", "yolo11n")))
    save_model(tmp_path / "weights" / "yolo11n.pt", "yolo11n")
    check_start(TrainingConfig())
    assert downloads == []


@pytest.mark.parametrize("content", [b"", b"weights", b"\x80\x02K\x01.", b"PK\x03\x04 cut off"])
def test_damaged_weights_are_named(downloads: list[str], tmp_path: Path, content: bytes) -> None:
    for path in (tmp_path / "own.pt", tmp_path / "weights" / "yolo11n.pt"):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    with pytest.raises(
        ConfigError, match=r"own\.pt: cannot be read as detector weights .*; give another file, or auto"
    ):
        check_start(TrainingConfig(pretrained=tmp_path / "own.pt"))
    with pytest.raises(ConfigError, match=r"yolo11n\.pt: cannot be read .*; replace or remove it"):
        check_start(TrainingConfig())
    check_start(TrainingConfig(pretrained="never"))
    assert downloads == []


def test_unusable_initial_weights_are_an_error(downloads: list[str], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="try yolo11n"):
        check_start(TrainingConfig(model="yolo99n"))
    with pytest.raises(ConfigError, match="no such weights file"):
        check_start(TrainingConfig(pretrained=tmp_path / "none.pt"))
    with pytest.raises(ConfigError, match="File name too long"):
        check_start(TrainingConfig(pretrained=tmp_path / ("n" * 300)))
    with pytest.raises(ConfigError, match="last layer Segment"):
        check_start(TrainingConfig(pretrained=save_model(tmp_path / "seg.pt", "yolo11n-seg")))


# tests replace `pretrained.FOLDER`
FOLDER = Path(annotator.__file__).parent / "detection" / "base"
MOST_BYTES = 8_000_000


def test_the_package_has_the_weights_that_its_manifest_describes() -> None:
    manifest = json.loads((FOLDER / "manifest.json").read_bytes())
    trained = read_trained(FOLDER)
    content = trained.weights.read_bytes()
    assert hashlib.sha256(content).hexdigest() == manifest["weights_sha256"]
    assert len(content) < MOST_BYTES
    assert trained.classes == tuple(AGNOSTIC_LABELS.values())
    assert trained.image_size_px == manifest["image_size_px"]
    assert set(trained.edge_errors) == set(trained.classes)
