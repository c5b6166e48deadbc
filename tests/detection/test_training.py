"""Training runs: progress, cancelling, resuming, and stored files."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection.config import TrainingConfig
from annotator.detection.trained import RunRecord, TrainedModel, read_trained
from annotator.detection.training import TrainingProgress, TrainingStoppedError, Watch, train_detector, trainer_settings
from annotator.detection.ultralytics_api import api, pick_device
from annotator.files import remove_abandoned
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
