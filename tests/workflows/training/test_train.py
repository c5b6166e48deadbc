"""The training workflow: samples, stored files and registered models. The training itself is replaced."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from view_detectors import Fixed, trained_model

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import read_manifest
from annotator.detection.trained import TrainedModel, TrainingMetrics
from annotator.detection.training import TrainingProgress
from annotator.project import Project, WriteContext
from annotator.rcv.config import RcvConfig, ViewConfig
from annotator.types import Box2D, BoxKind, DetectorKind
from annotator.types.errors import ConfigError, DetectionError
from annotator.workflows.simulate import simulate_recording
from annotator.workflows.training import rounds, run
from annotator.workflows.training import train as workflow
from annotator.workflows.training.run import run_name
from annotator.workflows.training.samples import SampleConfig, gather, view_samples
from annotator.workflows.training.train import TrainPlan, train

SMALL = TrainingConfig(image_size_px=64, epochs=1)
PLAN = TrainPlan(image=SMALL, view=SMALL, samples=SampleConfig(views=18))


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

    monkeypatch.setattr(run, "train_detector", train_detector)
    monkeypatch.setattr(run, "load_detector", lambda weights: Fixed(labels=(), fingerprint=f"f-{weights.read_text()}"))
    return calls


def simulate(project: Project, kind: BoxKind = BoxKind.BOX) -> None:
    simulate_recording(project, project.recordings.all()[0].id, kind, RcvConfig(), every=2)


@pytest.mark.parametrize("kind", list(BoxKind))
def test_both_detectors_are_trained_registered_and_active(
    people: Project, trainings: list[tuple[str, Path, Path]], kind: BoxKind
) -> None:
    simulate(people, kind)
    told: list[DetectorKind] = []
    trained = train(people, PLAN, progress=lambda role, step: told.append(role))
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
    assert {"drawn", "taught"} == {name for counts in views.images_by_origin.values() for name in counts}


def test_the_same_labels_and_settings_give_the_same_run(
    people: Project, trainings: list[tuple[str, Path, Path]]
) -> None:
    simulate(people)
    first, second = (train(people, PLAN) for _ in range(2))
    assert [call[2] for call in trainings[:2]] == [call[2] for call in trainings[2:]]
    assert [result.model.id for result in first] == [result.model.id for result in second]
    assert len(people.models.all()) == 2, "no second model is registered"


def test_a_finished_training_does_not_need_its_initial_weights(
    people: Project, trainings: list[tuple[str, Path, Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate(people)
    plan = TrainPlan(
        image=SMALL.model_copy(update={"pretrained": tmp_path / "gone.pt"}), view=SMALL, samples=PLAN.samples
    )
    with pytest.raises(ConfigError, match=r"gone\.pt: no such weights file"):
        train(people, plan, roles=(DetectorKind.IMAGE,))
    with monkeypatch.context() as there:
        there.setattr(workflow, "check_start", lambda config: None)
        (first,) = train(people, plan, roles=(DetectorKind.IMAGE,))
    first.result.write(first.model.path.parent)
    (again,) = train(people, plan, roles=(DetectorKind.IMAGE,))
    assert again.model.id == first.model.id


def test_other_labels_or_settings_give_another_run(people: Project, trainings: list[tuple[str, Path, Path]]) -> None:
    simulate(people)
    train(people, PLAN, roles=(DetectorKind.IMAGE,))
    train(people, TrainPlan(image=SMALL.model_copy(update={"epochs": 2}), view=SMALL), roles=(DetectorKind.IMAGE,))
    stored = people.frames.of()[1]
    box = Box2D("person", 1.0, 1.0, 50.0, 50.0)
    people.boxes.set_on_image(stored.id, [box], BoxKind.BOX, WriteContext(stored.revision, "me"))
    (last,) = train(people, PLAN, roles=(DetectorKind.IMAGE,))
    assert len({call[2] for call in trainings}) == 3
    assert people.models.active(DetectorKind.IMAGE) == last.model
    assert people.models.active(DetectorKind.VIEW) is None
    back = train(people, PLAN, roles=(DetectorKind.IMAGE,))[0]
    assert back.model.id == last.model.id


def test_an_image_detector_is_continued_on_new_labels(people: Project, trainings: list[tuple[str, Path, Path]]) -> None:
    def trained(**changes: object) -> TrainedModel:
        (result,) = train(people, TrainPlan(image=SMALL.model_copy(update=changes)), roles=(DetectorKind.IMAGE,))
        result.result.write(result.model.path.parent)
        return result.result

    simulate(people)
    first = trained()
    assert first.config.pretrained == "auto"
    assert trained().weights == first.weights, "the same labels give the same detector"
    stored = people.frames.of()[1]
    box = Box2D("person", 1.0, 1.0, 50.0, 50.0)
    people.boxes.set_on_image(stored.id, [box], BoxKind.BOX, WriteContext(stored.revision, "me"))
    second = trained()
    assert second.config.pretrained == first.weights
    assert trained().weights == second.weights, "the same labels give the same detector"
    for changes in ({"image_size_px": 96}, {"pretrained": "never"}, {"model": "yolov8n"}):
        assert trained(**changes).config.pretrained != second.weights
        model = next(m for m in people.models.all(DetectorKind.IMAGE) if m.path == second.weights)
        people.models.activate(model.id)


def test_an_image_detector_that_has_learned_held_out_images_is_not_continued(
    people: Project, trainings: list[tuple[str, Path, Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    simulate(people)
    (first,) = train(people, PLAN, roles=(DetectorKind.IMAGE,))
    first.result.write(first.model.path.parent)
    learned = frozenset(entry.group for entry in first.manifest.entries if entry.split == "train")
    monkeypatch.setattr(rounds, "held_out_groups", lambda project: learned)
    (other,) = train(people, replace(PLAN, image=SMALL.model_copy(update={"epochs": 2})), roles=(DetectorKind.IMAGE,))
    assert other.result.config.pretrained == "auto"


def test_pictures_of_deep_frustums_are_cut_into_tiles(people: Project, trainings: list[tuple[str, Path, Path]]) -> None:
    deep = RcvConfig().model_copy(update={"view": ViewConfig(deep=0.1)})
    simulate_recording(people, people.recordings.all()[0].id, BoxKind.BOX, deep, every=2)
    (trained,) = train(people, replace(PLAN, rcv=deep), roles=(DetectorKind.VIEW,))
    samples = list(view_samples(people, gather(people), deep, PLAN.samples, lambda *skipped: None))
    tiles = [len(sample.boxes) + 1 if sample.look_px else 1 for sample in samples]
    assert sum(trained.manifest.images.values()) == sum(tiles) > len(samples)


def test_run_names_depend_only_on_labels_and_settings(people: Project, trainings: list[tuple[str, Path, Path]]) -> None:
    simulate(people)
    (trained,) = train(people, PLAN, roles=(DetectorKind.VIEW,))
    name = run_name(trained.manifest, SMALL)
    assert trained.model.path.parent.name == name
    assert run_name(trained.manifest, SMALL.model_copy(update={"seed": 1})) != name


def test_left_out_samples_are_reported(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], trainings: list[tuple[str, Path, Path]]
) -> None:
    folder = own_copy("people")
    project = make_project(folder)
    simulate(project)
    view = project.boxes.on_views()[0]
    stored = project.frames.of()[1]
    project.boxes.set_on_view(
        view.view_id, view.boxes, BoxKind.SILHOUETTE, WriteContext(stored.revision, "me"), frame_id=stored.id
    )
    (folder / "depth" / "000002.png").write_bytes(b"")
    image, views = train(project, PLAN)
    (line,) = image.left_out
    assert line.startswith("frame 000002: ")
    assert views.left_out[0] == "1 pseudo-view whose boxes are not of the majority kind, box"
    assert views.left_out[1].startswith("frame 000002: ")
    assert sum(image.manifest.images.values()) == 2


def test_a_training_without_samples_leaves_no_files(people: Project) -> None:
    with pytest.raises(DetectionError, match="to learn from"):
        train(people, PLAN)
    assert list(people.models_folder.iterdir()) == []


def test_pictures_without_any_box_are_an_error(people: Project) -> None:
    people.boxes.set_on_image(people.frames.of()[0].id, [], BoxKind.BOX, WriteContext(0, "me"))
    with pytest.raises(DetectionError, match="at least one labelled box"):
        train(people, PLAN, roles=(DetectorKind.IMAGE,))
    assert people.models.all() == ()
