"""What a training starts from, its parts, and which detector is used afterwards: held-out frames decide."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_warm_start import AnyClass
from view_detectors import CONFIG, HELD_OUT, PLAN, Fixed, held, install_base, register, write_model

from annotator.detection import pretrained
from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import read_manifest
from annotator.detection.trained import TrainedModel, read_trained
from annotator.detection.training import TrainingStoppedError
from annotator.detection.weights import NetworkDescription, build, write_network
from annotator.project import Project
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, Detector, DetectorKind, Frame
from annotator.workflows.detectors import (
    AGNOSTIC,
    Detectors,
    UsedModel,
    base_model,
    load_detector,
    own_model,
    used_model,
)
from annotator.workflows.training import held_out
from annotator.workflows.training import train as workflow
from annotator.workflows.training.held_out import HeldOut
from annotator.workflows.training.model_report import decision_of
from annotator.workflows.training.rounds import Choice
from annotator.workflows.training.samples import gather
from annotator.workflows.training.train import Trained, train


def test_a_training_starts_from_the_best_detector_on_held_out_frames(labelled: Project, ious: dict[str, float]) -> None:
    measured = held(labelled)
    assert Choice(labelled, measured, CONFIG).origin is None
    install_base()
    ious["base detector"] = 0.5
    assert Choice(labelled, measured, CONFIG).origin == base_model()
    active, newest = register(labelled, "a", active=True), register(labelled, "b")
    for a, b, best in ((0.6, 0.4, active), (0.4, 0.6, newest), (0.3, 0.4, None)):
        ious.update(a=a, b=b)
        start = Choice(labelled, measured, CONFIG)
        assert start.origin == (base_model() if best is None else own_model(labelled, best))
        assert sorted(rival.mean_iou for rival in start.compared) == sorted([a, b, 0.5])
    # weights or a network that the settings name come first
    for changes in ({"pretrained": "never"}, {"model": "yolov8n"}, {"image_size_px": 96}):
        assert Choice(labelled, measured, CONFIG.model_copy(update=changes)).origin is None


def test_a_training_takes_the_view_size_of_the_detector_that_it_starts_from(
    labelled: Project, ious: dict[str, float]
) -> None:
    write_model(pretrained.FOLDER, size_px=96)
    ious["base detector"] = 0.5
    start = Choice(labelled, held(labelled), CONFIG)
    assert (start.origin, start.view_px) == (base_model(), 96)
    assert Choice(labelled, held(labelled), CONFIG.model_copy(update={"image_size_px": 128})).origin is None


@pytest.mark.parametrize("learned", [HELD_OUT[0], None])
@pytest.mark.parametrize("objects", [0, 6])
def test_no_training_starts_from_a_detector_that_may_know_held_out_frames(
    labelled: Project, ious: dict[str, float], learned: str | None, objects: int
) -> None:
    ious["a"] = 0.9
    register(labelled, "a", active=True, learned=learned)
    assert Choice(labelled, held(labelled, objects), CONFIG).origin is None


def test_a_damaged_detector_is_left_out_and_reported(labelled: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    install_base()
    register(labelled, "a", active=True)  # its weights are no weights

    def measure(self: HeldOut, model: UsedModel) -> float:
        return 0.5 if model == base_model() else float(len(load_detector(model.path).labels))

    monkeypatch.setattr(HeldOut, "mean_iou", measure)
    start = Choice(labelled, held(labelled), CONFIG)
    assert start.origin == base_model()
    (line,) = start.left_out
    assert line.startswith("the project's detector a, which cannot be measured: ")


def choice_of(project: Project, objects: int = 6, **changes: str) -> Choice:
    """The choice of a training with these settings that begins now."""
    return Choice(project, held(project, objects), CONFIG.model_copy(update=changes))


def test_a_detector_from_random_weights_is_used_only_if_it_is_better(labelled: Project, ious: dict[str, float]) -> None:
    register(labelled, "a", active=True)
    ious.update(a=0.6, worse=0.3, better=0.7)
    choice = choice_of(labelled, pretrained="never")
    assert choice.origin is None
    for name, outcome in (
        ("worse", "no better on held-out frames: the project's detector a stayed in use"),
        ("better", "the best one on held-out frames: put into use"),
    ):
        new = register(labelled, name)
        assert choice.add(new, "").outcome == outcome
        # the next part goes on from the training's own result
        assert choice.origin == own_model(labelled, new)


def test_a_detector_chosen_by_hand_during_a_training_stays(labelled: Project, ious: dict[str, float]) -> None:
    old, chosen = register(labelled, "old", active=True), register(labelled, "chosen")
    ious.update(old=0.5, chosen=0.1, new=0.9, newer=0.95)
    choice = choice_of(labelled)
    labelled.models.activate(chosen.id)
    for name in ("new", "newer"):
        outcome = choice.add(register(labelled, name), "").outcome
        assert outcome == "another detector was chosen during the training: it stayed in use"
    assert labelled.models.get(chosen.id).active
    assert not labelled.models.get(old.id).active


def test_a_new_detector_is_used_only_if_it_is_better(labelled: Project, ious: dict[str, float]) -> None:
    install_base()
    ious.update({"base detector": 0.5, "worse": 0.4, "better": 0.6, "between": 0.55})
    choice = choice_of(labelled)
    used = []
    for name in ("worse", "better", "between"):
        decision = choice.add(register(labelled, name), "starts from the base detector")
        now = used_model(labelled, DetectorKind.VIEW)
        assert now is not None
        used.append(now.fingerprint)
        model = labelled.models.all(DetectorKind.VIEW)[-1]
        assert decision_of(model) == decision
        assert (decision.mean_iou, decision.objects, decision.frames) == (ious[name], choice.held_out.objects, 2)
        assert [(rival.name, rival.mean_iou) for rival in decision.compared] == [("base detector", 0.5)]
    assert used == ["base detector", "better", "better"]


def test_the_base_detector_comes_back_if_it_is_better_than_the_active_one(
    labelled: Project, ious: dict[str, float]
) -> None:
    install_base()
    register(labelled, "old", active=True)
    ious.update({"base detector": 0.5, "old": 0.3, "new": 0.4})
    choice_of(labelled).add(register(labelled, "new"), "")
    assert labelled.models.active(DetectorKind.VIEW) is None
    assert used_model(labelled, DetectorKind.VIEW) == base_model()


@pytest.mark.parametrize(
    ("has_base", "own", "used"), [(True, False, "base detector"), (True, True, "own"), (False, False, "new")]
)
def test_below_five_held_out_objects_what_was_in_use_stays(
    labelled: Project, ious: dict[str, float], has_base: bool, own: bool, used: str
) -> None:
    if has_base:
        install_base()
    if own:
        register(labelled, "own", active=True)
    choice = choice_of(labelled, 0)
    assert not choice.held_out.decides
    decision = choice.add(register(labelled, "new"), "")
    now = used_model(labelled, DetectorKind.VIEW)
    assert now is not None and now.fingerprint == used
    assert decision.mean_iou is None
    assert "fewer than 5 reviewed objects" in decision.outcome


@pytest.mark.slow
def test_a_round_continues_the_base_detector_for_the_time_it_is_given(labelled: Project) -> None:
    install_base()
    network = build(NetworkDescription(architecture="yolo11n", labels=AGNOSTIC))
    write_network(pretrained.FOLDER / "detector.safetensors", network)
    plan = replace(PLAN, view=CONFIG.model_copy(update={"epochs": None}), minutes=0.2)
    begin = time.monotonic()
    (trained,) = train(labelled, plan, roles=(DetectorKind.VIEW,))
    assert time.monotonic() - begin > 5
    assert trained.decision is not None
    assert trained.decision.started_from == "starts from the base detector"
    stored = read_trained(trained.model.path.parent)
    assert (stored.classes, stored.kind) == (AGNOSTIC, BoxKind.BOX)
    assert stored.config.seconds == pytest.approx(10.0)
    entries = read_manifest(trained.model.path.parent).entries
    assert ("train", "generated") in {(entry.split, entry.origin) for entry in entries}
    assert own_model(labelled, trained.model).class_agnostic


@pytest.mark.parametrize(
    ("minutes", "pretrained", "holds_out", "parts", "anew"),
    [
        (60.0, "auto", True, 5, [2]),
        (60.0, "auto", False, 5, []),
        (12.0, "auto", True, 3, []),
        # after the first part, each continues the best one so far
        (60.0, "never", True, 5, [0]),
    ],
)
def test_a_long_training_also_begins_anew_where_held_out_objects_decide(
    labelled: Project,
    monkeypatch: pytest.MonkeyPatch,
    minutes: float,
    pretrained: str,
    holds_out: bool,
    parts: int,
    anew: list[int],
) -> None:
    install_base()
    origins: list[UsedModel | None] = []

    def part(self: object, choice: Choice, origin: UsedModel | None, number: int, *_: object) -> Trained:
        origins.append(origin)
        model = register(labelled, f"part{number}")
        folder = model.path.parent
        decision = choice.add(model, "")
        return Trained(DetectorKind.VIEW, model, read_trained(folder), read_manifest(folder), decision=decision)

    monkeypatch.setattr("annotator.workflows.training.train._ViewTraining._part", part)
    monkeypatch.setattr(HeldOut, "mean_iou", lambda *_: 0.5)
    if not holds_out:
        monkeypatch.setattr(held_out, "is_held_out", lambda _: False)
    view = CONFIG.model_copy(update={"epochs": None, "pretrained": pretrained})
    (trained,) = train(labelled, replace(PLAN, view=view, minutes=minutes), roles=(DetectorKind.VIEW,))
    assert trained.model.fingerprint == f"part{parts - 1}"
    assert len(origins) == parts
    assert [number for number, origin in enumerate(origins) if origin is None] == anew


def test_the_reviewed_objects_of_held_out_frames_are_measured(
    labelled: Project, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = held(labelled)
    assert (measured.frames, measured.decides) == (2, True)
    assert 5 <= measured.objects <= 6
    model = UsedModel(write_model(labelled.models_folder / "m"), BoxKind.BOX, True, "f")
    results = []
    for detector in (AnyClass(knowing("people").view), Fixed()):
        monkeypatch.setattr(held_out, "load_detector", lambda path, names=(), detector=detector: detector)
        results.append(measured.mean_iou(model))
    # without any detection, objects are still placed by the size of the reviewed boxes
    assert results[0] > 0.7 > results[1]


@pytest.mark.parametrize("class_agnostic", [True, False])
def test_a_class_agnostic_detector_is_measured_at_what_the_reviewed_boxes_enclose(
    labelled: Project, monkeypatch: pytest.MonkeyPatch, class_agnostic: bool
) -> None:
    kinds = set()

    def lifted(frame: Frame, image_boxes: Sequence[Box2D], detector: Detector, config: RcvConfig, *rest: Any) -> Any:
        kinds.add(config.box_kind)
        return [None] * len(image_boxes)

    monkeypatch.setattr(held_out, "lifted", lifted)
    monkeypatch.setattr(held_out, "load_detector", lambda path, names=(): Fixed())
    measured = HeldOut(labelled, gather(labelled).labels, kind=BoxKind.SILHOUETTE)
    measured.mean_iou(UsedModel(write_model(labelled.models_folder / "m"), BoxKind.BOX, class_agnostic, "f"))
    assert kinds == {BoxKind.SILHOUETTE if class_agnostic else BoxKind.BOX}


@pytest.mark.parametrize("has_base", [True, False])
def test_no_held_out_frame_teaches_either_detector(
    labelled: Project, monkeypatch: pytest.MonkeyPatch, has_base: bool
) -> None:
    if has_base:
        install_base()
    sets: dict[DetectorKind, Mapping[str, set[str]]] = {}

    def stop_at_training(dataset: Path, out: Path, config: TrainingConfig, progress, role, stop) -> TrainedModel:
        entries = read_manifest(dataset).entries
        sets[role] = {
            split: {e.group for e in entries if e.split == split and e.origin != "generated"}
            for split in ("train", "val")
        }
        raise TrainingStoppedError("here")

    monkeypatch.setattr(workflow, "train_detector", stop_at_training)
    monkeypatch.setattr(HeldOut, "mean_iou", lambda *_: 0.5)
    monkeypatch.setattr("annotator.workflows.training.train.load_detector", lambda path, names=(): Fixed())
    for role in DetectorKind:
        with pytest.raises(TrainingStoppedError):
            train(labelled, PLAN, roles=(role,))
    recording = labelled.recordings.all()[0].id
    for role in DetectorKind:
        assert sets[role]["val"] == {f"{recording}/{key}" for key in HELD_OUT}
        assert sets[role]["train"] == {f"{recording}/{number:06d}" for number in (0, 2, 4)}
