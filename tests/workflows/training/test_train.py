"""The training workflow: samples, stored files, registered models, stops. The training itself is replaced."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from view_detectors import PLAN, Fixed, held, register, trained_model

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import TrainingSample, read_manifest, write_dataset
from annotator.detection.trained import LAST, STATE, RunRecord, TrainedModel, TrainingMetrics, TrainingState
from annotator.detection.training import TrainingProgress, TrainingStoppedError
from annotator.detection.weights import write_tensors
from annotator.files import lock_folder
from annotator.project import Project, WriteContext
from annotator.rcv import pseudo_view
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, DetectorKind
from annotator.workflows.detectors import Detectors, own_model
from annotator.workflows.simulate import simulate_recording
from annotator.workflows.training import held_out, rounds
from annotator.workflows.training import train as workflow
from annotator.workflows.training.model_report import PICTURES, _curves, validation_pictures, write_validation_pictures
from annotator.workflows.training.samples import SampleConfig, gather, view_samples
from annotator.workflows.training.train import TrainPlan, train

SMALL = TrainingConfig(image_size_px=64, epochs=1)
QUICK = TrainPlan(image=SMALL, view=SMALL, samples=SampleConfig(views=18))


@pytest.fixture
def trainings(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Path, Path]]:
    """Replaces the YOLO training by one that writes fake weights; returns (role, dataset, folder) of each call."""
    calls: list[tuple[str, Path, Path]] = []

    def train_detector(dataset: Path, out: Path, config: TrainingConfig, progress, role, stop) -> TrainedModel:
        calls.append((role, dataset, out))
        if progress is not None:
            progress(TrainingProgress(role, 1, 1, 0, 1, {}, None, None, 1.0, 0.0, ""))
        out.mkdir(parents=True, exist_ok=True)
        manifest = read_manifest(dataset)
        (out / "detector.pt").write_text(manifest.sha256)
        metrics = TrainingMetrics(map50=0.5, map50_95=0.25, precision=1, recall=0, measured_on=manifest.measured_on)
        return trained_model(
            out / "detector.pt", role=role, classes=manifest.classes, kind=manifest.kind, metrics=metrics,
            image_size_px=config.image_size_px, dataset_sha256=manifest.sha256, config=config,
        )  # fmt: skip

    monkeypatch.setattr(workflow, "train_detector", train_detector)
    monkeypatch.setattr(
        workflow, "load_detector", lambda weights: Fixed(labels=(), fingerprint=f"f-{weights.read_text()}")
    )
    return calls


def simulate(project: Project, kind: BoxKind = BoxKind.BOX) -> None:
    simulate_recording(project, project.recordings.all()[0].id, kind, RcvConfig(), every=2)


@pytest.fixture
def drawn(prepared: Callable[..., Project]) -> Project:
    """People with boxes on three of five frames."""
    return prepared("drawn_boxes", simulate)


@pytest.mark.parametrize("kind", list(BoxKind))
def test_both_detectors_are_trained_registered_and_active(
    people: Project, trainings: list[tuple[str, Path, Path]], kind: BoxKind
) -> None:
    simulate(people, kind)
    told: list[DetectorKind] = []
    trained = train(people, QUICK, progress=lambda role, step: told.append(role))
    assert [call[0] for call in trainings] == told == [DetectorKind.IMAGE, DetectorKind.VIEW]
    for result in trained:
        model = people.models.active(result.role)
        assert model == result.model
        assert model is not None
        assert (model.box_kind, model.labels) == (kind, ("person",))
        assert model.metrics == {"map50": 0.5, "map50_95": 0.25, "precision": 1, "recall": 0}
        assert model.path.parent.parent == people.models_folder / result.role
        assert model.manifest is not None
        kept = json.loads(model.manifest.read_text())
        assert kept["sha256"] == result.manifest.sha256
        assert kept["kind"] == kind
        assert result.left_out == ()
    images, views = (result.manifest for result in trained)
    assert sum(images.images.values()) == 3
    assert {"drawn", "taught"} == {entry.origin for entry in views.entries}


def test_the_same_labels_and_settings_give_the_same_run(
    drawn: Project, trainings: list[tuple[str, Path, Path]]
) -> None:
    first, second = (train(drawn, QUICK) for _ in range(2))
    assert [call[2] for call in trainings[:2]] == [call[2] for call in trainings[2:]]
    assert [result.model.id for result in first] == [result.model.id for result in second]
    assert len(drawn.models.all()) == 2, "no second model is registered"


def test_an_image_detector_is_continued_on_new_labels(drawn: Project, trainings: list[tuple[str, Path, Path]]) -> None:
    def trained(**changes: object) -> TrainedModel:
        (result,) = train(drawn, TrainPlan(image=SMALL.model_copy(update=changes)), roles=(DetectorKind.IMAGE,))
        result.result.write(result.model.path.parent)
        return result.result

    first = trained()
    assert first.config.pretrained == "auto"
    assert trained().weights == first.weights, "the same labels give the same detector"
    stored = drawn.frames.of()[1]
    box = Box2D("person", 1.0, 1.0, 50.0, 50.0)
    drawn.boxes.set_on_image(stored.id, [box], BoxKind.BOX, WriteContext(stored.revision, "me"))
    second = trained()
    assert second.config.pretrained == first.weights
    assert trained().weights == second.weights, "the same labels give the same detector"
    for changes in ({"image_size_px": 96}, {"pretrained": "never"}, {"model": "yolov8n"}):
        assert trained(**changes).config.pretrained != second.weights
        model = next(m for m in drawn.models.all(DetectorKind.IMAGE) if m.path == second.weights)
        drawn.models.activate(model.id)


def test_an_image_detector_that_has_learned_held_out_images_is_not_continued(
    drawn: Project, trainings: list[tuple[str, Path, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    (first,) = train(drawn, QUICK, roles=(DetectorKind.IMAGE,))
    first.result.write(first.model.path.parent)
    learned = frozenset(entry.group for entry in first.manifest.entries if entry.split == "train")
    monkeypatch.setattr(rounds, "held_out_groups", lambda project: learned)
    (other,) = train(drawn, replace(QUICK, image=SMALL.model_copy(update={"epochs": 2})), roles=(DetectorKind.IMAGE,))
    assert other.result.config.pretrained == "auto"


@pytest.mark.usefixtures("trainings")
def test_pictures_of_deep_frustums_are_cut_into_tiles(people: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pseudo_view, "DEEP", 0.1)
    simulate_recording(people, people.recordings.all()[0].id, BoxKind.BOX, RcvConfig(), every=2)
    (trained,) = train(people, QUICK, roles=(DetectorKind.VIEW,))
    samples = list(view_samples(people, gather(people), RcvConfig(), QUICK.samples, lambda *skipped: None))
    tiles = [len(sample.boxes) + 1 if sample.look_px else 1 for sample in samples]
    assert sum(trained.manifest.images.values()) == sum(tiles) > len(samples)


def test_left_out_samples_are_reported(copied: tuple[Path, Project], trainings: list[tuple[str, Path, Path]]) -> None:
    folder, project = copied
    simulate(project)
    view = project.boxes.on_views()[0]
    stored = project.frames.of()[1]
    project.boxes.set_on_view(
        view.view_id, view.boxes, BoxKind.SILHOUETTE, WriteContext(stored.revision, "me"), frame_id=stored.id
    )
    (folder / "depth" / "000002.png").write_bytes(b"")
    image, views = train(project, QUICK)
    (line,) = image.left_out
    assert line.startswith("frame 000002: ")
    assert views.left_out[0] == "1 pseudo-view whose boxes are not of the majority kind, box"
    assert views.left_out[1].startswith("frame 000002: ")
    assert sum(image.manifest.images.values()) == 2


def test_a_training_can_be_stopped_while_it_draws_views_and_measures(
    labelled: Project, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[TrainingSample] = []
    monkeypatch.setattr(workflow, "write_dataset", lambda folder, samples, *_: written.extend(samples))
    for asked, role in ((2, DetectorKind.IMAGE), (6, DetectorKind.VIEW)):
        answers = iter([False] * asked + [True])
        with pytest.raises(TrainingStoppedError):
            train(labelled, PLAN, roles=(role,), stop=lambda answers=answers: next(answers))
    assert 0 < len(written) < 10

    def stopped() -> None:
        raise TrainingStoppedError("here")

    monkeypatch.setattr(held_out, "load_detector", lambda path, names=(): Fixed())
    measured = held(labelled)
    measured._check_stop = stopped
    with pytest.raises(TrainingStoppedError):
        measured.mean_iou(own_model(labelled, register(labelled, "a")))


def test_a_training_removes_what_killed_ones_left(labelled: Project) -> None:
    model = register(labelled, "registered")
    folder = model.path.parent.parent
    for name in ("registered", "timed", "resumable", "killed", "running"):
        (folder / name / "weights").mkdir(parents=True, exist_ok=True)
    record = RunRecord(fingerprint="", pretrained=False, note="", seconds=1.0)
    for name, groups in (("timed", []), ("resumable", [{"lr": 0.1}])):
        state = TrainingState(
            run=record, epoch=0, updates=1, best_fitness=None, stopper={}, metrics={}, groups=groups, plain={}
        )
        write_tensors(folder / name / "weights" / LAST, {}, {STATE: state.model_dump_json()})
    (folder / ".dataset.x1.unfinished").mkdir()
    lock = lock_folder(folder / "running")  # as `train_detector` does, in another process
    assert lock is not None
    workflow.remove_leftovers(labelled, DetectorKind.VIEW)
    assert {path.name for path in folder.iterdir()} >= {"registered", "resumable", "running"}
    assert not (folder / "timed").exists() and not (folder / "killed").exists()
    assert not (folder / ".dataset.x1.unfinished").exists()
    lock.close()


# with a low score, too
DETECTOR = Fixed(
    (Box2D("person", 10.0, 20.0, 40.0, 60.0, 0.9), Box2D("person", 60.0, 5.0, 75.0, 15.0, 0.1)), labels=("person",)
)


@pytest.mark.parametrize("groups", [1, 30])
def test_validation_pictures_are_written_beside_the_model(tmp_path: Path, groups: int) -> None:
    grey = np.full((80, 100, 3), 100, np.uint8)
    samples = [
        TrainingSample(grey, (Box2D("person", 10.0, 20.0, 40.0, 60.0),), str(number), "drawn")
        for number in range(groups)
    ]
    manifest = write_dataset(
        tmp_path / "set", samples, ("person",), lambda group: 0 < int(group) <= groups // 2, BoxKind.BOX
    )
    model = tmp_path / "model"
    model.mkdir()
    for _ in range(2):  # the second call replaces the first pictures
        paths = write_validation_pictures(tmp_path / "set", manifest, DETECTOR, model)
    assert len(paths) == min(manifest.images[manifest.measured_on], PICTURES)
    assert paths == validation_pictures(model)
    assert [path.name for path in model.iterdir()] == ["validation"]
    picture = cv2.imread(str(paths[0])).astype(int)
    assert max(picture.shape) == 448
    x, y = (round((number + 0.5) * picture.shape[1] / 100 - 0.5) for number in (10, 40))
    assert np.ptp(picture[y, x]) > 60, "the box's edge is coloured"


def test_curves_are_read_without_nan_values(tmp_path: Path) -> None:
    assert _curves(tmp_path / "none.csv") == ()
    head = "epoch,time,train/box_loss,metrics/mAP50(B),lr/pg0"
    (tmp_path / "curves.csv").write_text(f"{head}\n1,2.5,0.5,nan,0.1\n2,5,0.25,0.75,0.1\n")
    points = _curves(tmp_path / "curves.csv")
    assert [(point.epoch, point.metrics) for point in points] == [
        (1, {"box_loss": 0.5}),
        (2, {"box_loss": 0.25, "map50": 0.75}),
    ]
