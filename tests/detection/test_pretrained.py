"""What a training run starts from; no test here reaches for the network."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from annotator.detection.config import TrainingConfig
from annotator.detection.pretrained import check_model_name, find_starting_point, within
from annotator.detection.ultralytics_api import api
from annotator.types.errors import ConfigError


@pytest.fixture
def downloads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """An empty cache, and a downloader that fails and remembers what it was asked for."""
    asked: list[str] = []

    def fail(file: str, **_: Any) -> str:
        asked.append(file)
        raise ConnectionError("no route to host")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(api().downloads, "attempt_download_asset", fail)
    monkeypatch.setattr(api(), "weights_dir", tmp_path / "weights")
    monkeypatch.setattr(api(), "user_offline", False)
    return asked


@pytest.mark.parametrize("name", ["yolo11n", "yolov5nu", "yolov8n.pt", "yolo26n.yaml", "yolov10n"])
def test_detection_models_are_known_by_name(name: str) -> None:
    assert check_model_name(name) == name.split(".")[0]


@pytest.mark.parametrize("name", ["yolo99n", "yolo11n-seg", "yolo11n-cls", "rtdetr-l", "../yolo11n", "", "resnet"])
def test_others_are_an_error_that_names_some(name: str) -> None:
    with pytest.raises(ConfigError, match="try yolo11n"):
        check_model_name(name)


def test_no_network_means_random_weights_and_says_so(downloads: list[str]) -> None:
    start = find_starting_point(TrainingConfig(model="yolo11n"))
    assert (start.model, start.pretrained) == ("yolo11n.yaml", False)
    assert "random weights" in start.note
    assert "no route to host" in start.note
    assert len(downloads) == 1


def test_a_network_that_hangs_is_given_up(downloads: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api().downloads, "attempt_download_asset", lambda *_, **__: time.sleep(30))
    begin = time.monotonic()
    start = find_starting_point(TrainingConfig(download_timeout_s=0.2))
    assert time.monotonic() - begin < 10
    assert not start.pretrained
    assert "no answer" in start.note


def test_downloaded_weights_are_used(downloads: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def fetch(file: str, **_: Any) -> str:
        Path(file).write_bytes(b"weights")
        return file

    monkeypatch.setattr(api().downloads, "attempt_download_asset", fetch)
    start = find_starting_point(TrainingConfig(model="yolov8n"))
    assert start.pretrained
    assert Path(start.model) == tmp_path / "cache" / "annotator" / "weights" / "yolov8n.pt"
    assert "downloaded" in start.note


def test_weights_that_are_here_are_used_without_asking(downloads: list[str], tmp_path: Path) -> None:
    folder = tmp_path / "weights"
    folder.mkdir()
    (folder / "yolo11n.pt").write_bytes(b"weights")
    start = find_starting_point(TrainingConfig())
    assert (start.model, start.pretrained) == (str(folder / "yolo11n.pt"), True)
    assert downloads == []


def test_who_wants_to_stay_offline_is_not_asked(downloads: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api(), "user_offline", True)
    assert "YOLO_OFFLINE" in find_starting_point(TrainingConfig()).note
    assert not find_starting_point(TrainingConfig(pretrained="never")).pretrained
    assert downloads == []


def test_weights_of_ones_own(downloads: list[str], tmp_path: Path) -> None:
    own = tmp_path / "own.pt"
    with pytest.raises(ConfigError, match=r"own\.pt"):
        find_starting_point(TrainingConfig(pretrained=own))
    own.write_bytes(b"weights")
    assert find_starting_point(TrainingConfig(pretrained=own)).model == str(own)
    assert downloads == []


def test_an_error_in_the_thread_reaches_the_caller() -> None:
    def fail() -> None:
        raise KeyError("inside")

    with pytest.raises(KeyError, match="inside"):
        within(5.0, fail)
    assert within(5.0, lambda: 7) == 7
