"""Training runs: initial weights without network, progress, cancelling, resuming, and stored files."""

from __future__ import annotations

import csv
import hashlib
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import annotator
from annotator.detection import pretrained
from annotator.detection.config import TrainingConfig
from annotator.detection.pretrained import check_start, find_starting_point
from annotator.detection.trained import RunRecord, TrainedModel, read_trained
from annotator.detection.training import TrainingProgress, TrainingStoppedError, Watch, train_detector, trainer_settings
from annotator.detection.ultralytics_api import api, pick_device
from annotator.files import remove_abandoned
from annotator.rcv.config import AGNOSTIC_LABELS
from annotator.types import DetectorKind
from annotator.types.errors import ConfigError, DetectionError, FormatError

SHORT = TrainingConfig(pretrained="never", image_size_px=64, epochs=3, batch=6, measure_every=1, device="cpu")


def epochs_of(folder: Path) -> list[int]:
    with (folder / "curves.csv").open() as file:
        return [int(row["epoch"]) for row in csv.DictReader(file)]


def files_of_run(model: TrainedModel) -> list[str]:
    """The files of a training's folder, without the exports that other tests store there."""
    return sorted(path.name for path in model.weights.parent.iterdir())


@pytest.mark.slow
def test_a_finished_run_has_weights_metrics_and_curves(tiny_model: TrainedModel, tiny_dataset: Path) -> None:
    folder = tiny_model.weights.parent
    assert files_of_run(tiny_model) == ["curves.csv", "detector.safetensors", "model.json"]
    assert read_trained(folder) == tiny_model
    assert tiny_model.classes == ("blue", "red")
    # the accuracy depends on the processor
    assert tiny_model.metrics.map50 > 0.2
    assert tiny_model.metrics.measured_on == "val"
    assert not tiny_model.pretrained
    assert "random weights" in tiny_model.note
    assert epochs_of(folder) == list(range(1, tiny_model.epochs + 1))
    assert tiny_model.seconds > 0


@pytest.mark.slow
def test_a_finished_run_is_not_repeated_and_can_be_moved(
    tiny_model: TrainedModel, tiny_dataset: Path, quick_config: TrainingConfig, tmp_path: Path
) -> None:
    folder = tmp_path / "moved"
    folder.mkdir()
    for name in files_of_run(tiny_model):
        (folder / name).write_bytes((tiny_model.weights.parent / name).read_bytes())
    again = train_detector(tiny_dataset, folder, quick_config, lambda _: pytest.fail("trained again"))
    assert again.weights == folder / "detector.safetensors"
    assert again.metrics == tiny_model.metrics


@pytest.mark.slow
def test_an_interrupted_run_resumes(tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    threads = api().torch.get_num_threads()
    out, seen = tmp_path / "run", []

    def interrupt(progress: TrainingProgress) -> None:
        seen.append(progress)
        assert not remove_abandoned(out), "no other process takes it for a killed run"
        if progress.epoch == 1 and progress.batch == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_detector(tiny_dataset, out, SHORT, interrupt)
    assert not (out / "model.json").exists()
    with pytest.raises(FormatError, match="interrupted"):
        read_trained(out)

    # The second time it is stopped by the callback, one epoch later.
    with pytest.raises(TrainingStoppedError, match="epoch 2 of 3"):
        train_detector(tiny_dataset, out, SHORT, seen.append, stop=lambda: True)

    done = train_detector(tiny_dataset, out, SHORT, seen.append)
    assert done.epochs == 3
    assert epochs_of(out) == [1, 2, 3]
    whole = [p.epoch for p in seen if p.batch == 0]
    assert whole == [1, 2, 3]
    assert [(p.epoch, p.batch, p.batches) for p in seen[:3]] == [(0, 1, 2), (0, 2, 2), (1, 0, 2)]
    assert all(p.epochs == 3 and p.losses.keys() == {"box_loss", "cls_loss", "dfl_loss"} for p in seen)
    assert seen[0].map50 is None
    assert seen[2].map50 is not None
    assert seen[-1].seconds_left == pytest.approx(0, abs=1e-6)
    assert list(work.iterdir()) == []
    assert api().torch.get_num_threads() == threads


@pytest.mark.slow
def test_a_run_of_fixed_duration_that_ends_after_an_unmeasured_epoch_is_measured(
    tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_epoch = Watch.on_epoch

    def late(self: Watch, trainer: Any) -> None:
        on_epoch(self, trainer)
        if trainer.epoch == 1:  # as if writing the checkpoint had taken the rest of the time
            trainer.train_time_start -= 3600.0

    monkeypatch.setattr(Watch, "on_epoch", late)
    config = TrainingConfig(
        pretrained="never", image_size_px=96, batch=6, measure_every=1_000_000, device="cpu", seconds=300.0
    )
    trained = train_detector(tiny_dataset, tmp_path / "run", config)
    assert trained.epochs == 2
    assert 0.0 <= trained.metrics.map50 <= 1.0


@pytest.mark.slow
def test_other_settings_or_a_damaged_checkpoint_restart_the_training(tiny_dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"

    def stop_after_one(progress: TrainingProgress) -> None:
        if progress.epoch == 1:
            raise KeyboardInterrupt

    def first_epoch(config: TrainingConfig) -> int:
        seen: list[TrainingProgress] = []

        def watch(progress: TrainingProgress) -> None:
            seen.append(progress)
            if progress.batch == 1:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train_detector(tiny_dataset, out, config, watch)
        return seen[0].epoch

    with pytest.raises(KeyboardInterrupt):
        train_detector(tiny_dataset, out, SHORT, stop_after_one)
    assert first_epoch(SHORT) == 1
    last = out / "weights" / "last.safetensors"
    last.write_bytes(last.read_bytes()[:5000])
    assert first_epoch(SHORT) == 0
    with pytest.raises(KeyboardInterrupt):
        train_detector(tiny_dataset, out, SHORT, stop_after_one)
    assert first_epoch(SHORT.model_copy(update={"seed": 1})) == 0


def test_what_cannot_be_trained_is_refused_before_the_training(tiny_dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "own.pt").write_bytes(b"weights")
    run = tmp_path / "run"
    run.mkdir()
    (run / "model.json").write_text("an older run")
    for dataset, changes, error, problem in (
        (tmp_path, {}, FormatError, "training set"),
        (tiny_dataset, {"model": "yolo99z"}, ConfigError, "yolo99z"),
        (tiny_dataset, {"device": "cuda:77"}, DetectionError, "device"),
        (
            tiny_dataset,
            {"pretrained": tmp_path / "own.pt"},
            ConfigError,
            r"own\.pt: cannot be read as detector weights",
        ),
    ):
        with pytest.raises(error, match=problem):
            train_detector(dataset, run, SHORT.model_copy(update=changes))
    with pytest.raises(ConfigError, match="question mark; rename it"):
        train_detector(tiny_dataset, tmp_path / "what?" / "run", SHORT)
    assert (run / "model.json").read_text() == "an older run"
    assert {path.name for path in tmp_path.iterdir()} == {"own.pt", "run"}


def test_augmented_boxes_still_fit_their_object(tiny_dataset: Path, tmp_path: Path) -> None:
    """With all augmentations at once, each label must be the box around the coloured pixels of the augmented image."""
    from annotator.detection.dataset import read_manifest
    from annotator.detection.trainer import make_trainer

    config = TrainingConfig(image_size_px=96, recipe={"scale": 0.3})
    begun = RunRecord(fingerprint="", pretrained=False, note="", seconds=0.0)
    manifest, device = read_manifest(tiny_dataset), pick_device("cpu")
    watch = Watch(tiny_dataset, manifest, config, DetectorKind.VIEW, tmp_path / "run", device, begun)
    settings = trainer_settings(config, DetectorKind.VIEW, 1, "cpu", tmp_path / "run")
    settings |= {"model": "yolo11n.yaml", "data": str(tiny_dataset / "data.yaml")}
    trainer = make_trainer(settings, watch)
    trainer.setup_model()
    dataset = trainer.build_dataset(trainer.data["train"], "train", 6)
    for index in [i % len(dataset) for i in range(60)]:
        item = dataset[index]
        picture = item["img"].numpy().transpose(1, 2, 0).astype(int)
        assert picture.shape == (96, 96, 3)
        rows, columns = np.nonzero(np.abs(picture - 114).max(axis=2) > 45)
        want = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        cx, cy, w, h = (item["bboxes"].numpy()[0] * 96).tolist()
        np.testing.assert_allclose([cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2], want, atol=1.3)


def test_muon_steps_have_singular_values_near_one_and_the_vectors_of_the_momentum() -> None:
    import torch

    from annotator.detection.trainer import orthogonalised

    for shape in ((8, 8), (4, 30), (30, 4)):
        u, _, v = np.linalg.svd(np.random.default_rng(0).normal(size=shape), full_matrices=False)
        momentum = torch.from_numpy((u * np.geomspace(5.0, 0.2, min(shape)) @ v).astype(np.float32))[None]
        within = u.T @ orthogonalised(momentum)[0].numpy() @ v.T
        assert (np.abs(np.diag(within) - 0.9) < 0.4).all()
        np.testing.assert_allclose(within, np.diag(np.diag(within)), atol=1e-3)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_detector(tiny_dataset: Path, tmp_path: Path) -> None:
    config = SHORT.model_copy(update={"epochs": 1})
    losses = []
    for name in "ab":
        train_detector(tiny_dataset, tmp_path / name, config)
        with (tmp_path / name / "curves.csv").open() as file:
            row = next(csv.DictReader(file))
        losses.append({key: float(value) for key, value in row.items() if key.startswith("train/")})
    assert losses[0]
    assert losses[0] == pytest.approx(losses[1], rel=1e-3)


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
