"""Training in rounds: held-out frames decide where a training starts and which view detector is used."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.detection import base_detector
from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import TrainingSample
from annotator.detection.manifest import DatasetManifest, ManifestEntry, read_manifest
from annotator.detection.network_file import NetworkDescription, build, write_network
from annotator.detection.progress import TrainingProgress, TrainingStoppedError
from annotator.detection.trained import RunRecord, TrainedModel, TrainingMetrics, read_trained
from annotator.project import NewLabel, Origin, Project, StoredModel, WriteContext
from annotator.rcv.config import RcvConfig
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Detector, DetectorKind, Frame, Image
from annotator.workflows.detectors import (
    AGNOSTIC,
    Detectors,
    UsedModel,
    base_model,
    load_detector,
    own_model,
    used_model,
)
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.simulate import image_box_of, simulate_recording, visible_objects
from annotator.workflows.training import held_out, run
from annotator.workflows.training.agnostic_samples import agnostic_samples, with_generated
from annotator.workflows.training.held_out import HeldOut, read_decision
from annotator.workflows.training.rounds import Choice, choose_start, part_seconds
from annotator.workflows.training.samples import SampleConfig, gather
from annotator.workflows.training.train import TrainPlan, train

WHOLE, SEEN = AGNOSTIC
CONFIG = TrainingConfig(image_size_px=64, epochs=1)
PLAN = TrainPlan(image=CONFIG, view=CONFIG, samples=SampleConfig(views=24), generated_share=0.3)
HELD_OUT = ("000001", "000003")


@dataclass(frozen=True)
class Fixed:
    """A detector with the same boxes on every image."""

    boxes: tuple[Box2D, ...] = ()
    fingerprint: str = "fixed"
    labels: tuple[str, ...] = AGNOSTIC

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [list(self.boxes) for _ in images]


class AnyClass:
    """The boxes of another detector without their classes."""

    labels, fingerprint = AGNOSTIC, "any class"

    def __init__(self, detector: Detector) -> None:
        self._detector = detector

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [[replace(box, label=WHOLE) for box in boxes] for boxes in self._detector.detect(images)]


@pytest.fixture(autouse=True)
def no_base(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(base_detector, "FOLDER", tmp_path / "base")


@pytest.fixture
def labelled(people: Project, monkeypatch: pytest.MonkeyPatch) -> Project:
    """The project with the true boxes of all 5 frames and drawn views; two of the frames are held out."""
    recording = people.recordings.all()[0].id
    monkeypatch.setattr(held_out, "is_held_out", {f"{recording}/{key}" for key in HELD_OUT}.__contains__)
    import_own_labels(people, recording)
    simulate_recording(people, recording, BoxKind.BOX, RcvConfig(), every=1)
    return people


def write_model(folder: Path, size_px: int = 64) -> Path:
    """The files of a finished training."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "detector.safetensors"
    path.write_bytes(b"weights")
    metrics = TrainingMetrics(map50=0.5, map50_95=0.4, precision=0.5, recall=0.5, measured_on="val")
    TrainedModel(
        role=DetectorKind.VIEW, weights=path, classes=AGNOSTIC, kind=None, image_size_px=size_px, metrics=metrics,
        epochs=1, seconds=1.0, pretrained=False, note="from random weights", dataset_sha256="", config=CONFIG,
    ).write(folder)  # fmt: skip
    return path


def install_base() -> None:
    write_model(base_detector.FOLDER)


def register(project: Project, name: str, *, active: bool = False, learned: str | None = "000000") -> StoredModel:
    """
    Args:
        learned: key of a frame that it was trained on; None: unknown.
    """
    path = write_model(project.models_folder / "view" / name)
    manifest = path.parent / "manifest.json"
    if learned is not None:
        group = f"{project.recordings.all()[0].id}/{learned}"
        entry = ManifestEntry(image="0.png", split="train", group=group, origin="drawn", boxes=AGNOSTIC[:1])
        written = DatasetManifest(
            sha256="", classes=AGNOSTIC, kind=None, measured_on="train", images={"train": 1, "val": 0},
            boxes_by_class={}, images_by_origin={}, dropped_boxes=0, entries=(entry,),
        )  # fmt: skip
        manifest.write_text(written.model_dump_json(), encoding="utf-8")
    return project.models.register(
        DetectorKind.VIEW, path, labels=AGNOSTIC, box_kind=BoxKind.BOX, metrics={}, fingerprint=name, activate=active,
        manifest=None if learned is None else manifest,
    )  # fmt: skip


@pytest.fixture
def ious(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """The measured mean IoU of each detector by fingerprint, in place of a measurement."""
    table: dict[str, float] = {}
    monkeypatch.setattr(HeldOut, "mean_iou", lambda self, model: table[model.fingerprint])
    return table


def held(project: Project, objects: int = 6) -> HeldOut:
    """Of the project's labels, with a number of objects as given."""
    labels = gather(project).labels
    measured = HeldOut(project, labels)
    if objects < measured.objects:
        measured._frames[:] = []
    return measured


def test_the_reviewed_objects_of_held_out_frames_are_measured(
    labelled: Project, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = HeldOut(labelled, gather(labelled).labels)
    assert (measured.frames, measured.decides) == (2, True)
    assert 5 <= measured.objects <= 6
    model = UsedModel(write_model(labelled.models_folder / "m"), BoxKind.BOX, True, "f")
    detectors: dict[str, Detector] = {"perfect": AnyClass(knowing("people").view), "blind": Fixed()}
    results = {}
    for name, detector in detectors.items():
        monkeypatch.setattr(held_out, "load_detector", lambda path, detector=detector: detector)
        results[name] = measured.mean_iou(model)
    # without any detection, objects are still placed by the size of the reviewed boxes
    assert results["perfect"] > 0.7 > results["blind"]


@pytest.mark.parametrize("class_agnostic", [True, False])
def test_a_class_agnostic_detector_is_measured_at_what_the_reviewed_boxes_enclose(
    labelled: Project, monkeypatch: pytest.MonkeyPatch, class_agnostic: bool
) -> None:
    kinds = set()

    def lifted(frame: Frame, image_boxes: Sequence[Box2D], detector: Detector, config: RcvConfig, *rest: Any) -> Any:
        kinds.add(config.box_kind)
        return [None] * len(image_boxes)

    monkeypatch.setattr(held_out, "lifted", lifted)
    monkeypatch.setattr(held_out, "load_detector", lambda path: Fixed())
    measured = HeldOut(labelled, gather(labelled).labels, kind=BoxKind.SILHOUETTE)
    measured.mean_iou(UsedModel(write_model(labelled.models_folder / "m"), BoxKind.BOX, class_agnostic, "f"))
    assert kinds == {BoxKind.SILHOUETTE if class_agnostic else BoxKind.BOX}


def test_a_training_starts_from_the_best_detector_on_held_out_frames(labelled: Project, ious: dict[str, float]) -> None:
    measured = held(labelled)
    assert choose_start(labelled, measured, CONFIG).model is None
    install_base()
    ious["base detector"] = 0.5
    assert choose_start(labelled, measured, CONFIG).model == base_model()
    active, newest = register(labelled, "a", active=True), register(labelled, "b")
    for a, b, best in ((0.6, 0.4, active), (0.4, 0.6, newest), (0.3, 0.4, None)):
        ious.update(a=a, b=b)
        start = choose_start(labelled, measured, CONFIG)
        assert start.model == (base_model() if best is None else own_model(labelled, best))
        assert sorted(rival.mean_iou for rival in start.compared) == sorted([a, b, 0.5])
    # weights or a network that the settings name come first
    for changes in ({"pretrained": "never"}, {"model": "yolov8n"}, {"image_size_px": 96}):
        assert choose_start(labelled, measured, CONFIG.model_copy(update=changes)).model is None


def test_a_training_takes_the_view_size_of_the_detector_that_it_starts_from(
    labelled: Project, ious: dict[str, float]
) -> None:
    write_model(base_detector.FOLDER, size_px=96)
    ious["base detector"] = 0.5
    start = choose_start(labelled, held(labelled), CONFIG)
    assert (start.model, start.view_px(CONFIG)) == (base_model(), 96)
    assert choose_start(labelled, held(labelled), CONFIG.model_copy(update={"image_size_px": 128})).model is None


def test_a_detector_that_was_trained_on_held_out_frames_is_not_compared(
    labelled: Project, ious: dict[str, float]
) -> None:
    install_base()
    model = register(labelled, "a", active=True)
    manifest = run.Run(labelled, DetectorKind.VIEW, AGNOSTIC, BoxKind.BOX, holds_out=False).write(
        agnostic_samples(labelled, gather(labelled), RcvConfig(), PLAN.samples, Fixed(), lambda *_: None)
    )
    assert {e.group for e in manifest.entries if e.split == "train"} & held_out.held_out_groups(labelled)
    labelled.models.register(
        DetectorKind.VIEW, model.path, labels=AGNOSTIC, box_kind=BoxKind.BOX, metrics={}, fingerprint="a",
        manifest=labelled.models_folder / "view" / "dataset" / "manifest.json",
    )  # fmt: skip
    ious.update({"base detector": 0.2, "a": 0.9})
    assert choose_start(labelled, held(labelled), CONFIG).model == base_model()


@pytest.mark.parametrize("learned", [HELD_OUT[0], None])
@pytest.mark.parametrize("objects", [0, 6])
def test_no_training_starts_from_a_detector_that_may_know_held_out_frames(
    labelled: Project, ious: dict[str, float], learned: str | None, objects: int
) -> None:
    ious["a"] = 0.9
    register(labelled, "a", active=True, learned=learned)
    assert choose_start(labelled, held(labelled, objects), CONFIG).model is None
    # where held-out frames decide nothing, it may
    assert choose_start(labelled, held(labelled, 0), CONFIG, decides=False).model is not None


def test_a_damaged_detector_is_left_out_and_reported(labelled: Project, monkeypatch: pytest.MonkeyPatch) -> None:
    install_base()
    register(labelled, "a", active=True)  # its weights are no weights

    def measure(self: HeldOut, model: UsedModel) -> float:
        return 0.5 if model == base_model() else float(len(load_detector(model.path).labels))

    monkeypatch.setattr(HeldOut, "mean_iou", measure)
    start = choose_start(labelled, held(labelled), CONFIG)
    assert start.model == base_model()
    (line,) = start.left_out
    assert line.startswith("the project's detector a, which cannot be measured: ")


def test_a_detector_from_random_weights_is_used_only_if_it_is_better(labelled: Project, ious: dict[str, float]) -> None:
    active = register(labelled, "a", active=True)
    ious.update(a=0.6, worse=0.3, better=0.7)
    measured = held(labelled)
    start = choose_start(labelled, measured, CONFIG.model_copy(update={"pretrained": "never"}))
    assert start.model is None
    choice = Choice(labelled, measured, start)
    outcomes = []
    for name in ("worse", "better"):
        new = register(labelled, name)
        outcomes.append(choice.add(new, "").outcome)
        # the next part goes on from the training's own result
        assert choice.origin == own_model(labelled, new)
    assert outcomes == [
        "no better on held-out frames: the project's detector a stayed in use",
        "the best one on held-out frames: put into use",
    ]
    assert not labelled.models.get(active.id).active


def test_a_detector_chosen_by_hand_during_a_training_stays(labelled: Project, ious: dict[str, float]) -> None:
    old, chosen = register(labelled, "old", active=True), register(labelled, "chosen")
    ious.update(old=0.5, chosen=0.1, new=0.9, newer=0.95)
    measured = held(labelled)
    choice = Choice(labelled, measured, choose_start(labelled, measured, CONFIG))
    labelled.models.activate(chosen.id)
    for name in ("new", "newer"):
        outcome = choice.add(register(labelled, name), "").outcome
        assert outcome == "another detector was chosen during the training: it stayed in use"
    assert labelled.models.get(chosen.id).active
    assert not labelled.models.get(old.id).active


def test_a_new_detector_is_used_only_if_it_is_better(labelled: Project, ious: dict[str, float]) -> None:
    install_base()
    ious.update({"base detector": 0.5, "worse": 0.4, "better": 0.6, "between": 0.55})
    measured = held(labelled)
    choice = Choice(labelled, measured, choose_start(labelled, measured, CONFIG))
    used = []
    for name in ("worse", "better", "between"):
        decision = choice.add(register(labelled, name), "starts from the base detector")
        now = used_model(labelled, DetectorKind.VIEW)
        assert now is not None
        used.append(now.fingerprint)
        model = labelled.models.all(DetectorKind.VIEW)[-1]
        assert read_decision(model.path.parent) == decision
        assert (decision.mean_iou, decision.objects, decision.frames) == (ious[name], measured.objects, 2)
        assert [(rival.name, rival.mean_iou) for rival in decision.compared] == [("base detector", 0.5)]
    assert used == ["base detector", "better", "better"]


def test_the_base_detector_comes_back_if_it_is_better_than_the_active_one(
    labelled: Project, ious: dict[str, float]
) -> None:
    install_base()
    register(labelled, "old", active=True)
    ious.update({"base detector": 0.5, "old": 0.3, "new": 0.4})
    measured = held(labelled)
    Choice(labelled, measured, choose_start(labelled, measured, CONFIG)).add(register(labelled, "new"), "")
    assert labelled.models.active(DetectorKind.VIEW) is None
    assert used_model(labelled, DetectorKind.VIEW) == base_model()


@pytest.mark.parametrize("has_base", [True, False])
def test_below_five_held_out_objects_the_base_detector_stays(
    labelled: Project, ious: dict[str, float], has_base: bool
) -> None:
    if has_base:
        install_base()
    measured = held(labelled, 0)
    assert not measured.decides
    choice = Choice(labelled, measured, choose_start(labelled, measured, CONFIG))
    decision = choice.add(register(labelled, "new"), "")
    used = used_model(labelled, DetectorKind.VIEW)
    assert used is not None
    assert used.fingerprint == ("base detector" if has_base else "new")
    assert decision.mean_iou is None
    assert "fewer than 5 reviewed objects" in decision.outcome


def test_below_five_held_out_objects_an_own_detector_stays_in_use(labelled: Project, ious: dict[str, float]) -> None:
    install_base()
    active = register(labelled, "a", active=True)
    measured = held(labelled, 0)
    choice = Choice(labelled, measured, choose_start(labelled, measured, CONFIG))
    assert choice.add(register(labelled, "new"), "").outcome.endswith("what was in use stayed in use")
    assert labelled.models.get(active.id).active


def test_a_training_can_be_stopped_while_it_draws_views_and_measures(
    labelled: Project, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[TrainingSample] = []
    monkeypatch.setattr(run, "write_dataset", lambda folder, samples, *_: written.extend(samples))
    for asked, role in ((2, DetectorKind.IMAGE), (6, DetectorKind.VIEW)):
        answers = iter([False] * asked + [True])
        with pytest.raises(TrainingStoppedError):
            train(labelled, PLAN, roles=(role,), stop=lambda answers=answers: next(answers))
    assert 0 < len(written) < 10

    def stopped() -> None:
        raise TrainingStoppedError("here")

    monkeypatch.setattr(held_out, "load_detector", lambda path: Fixed())
    measured = held(labelled)
    measured._check_stop = stopped
    with pytest.raises(TrainingStoppedError):
        measured.mean_iou(own_model(labelled, register(labelled, "a")))


def test_a_training_removes_what_killed_ones_left(labelled: Project) -> None:
    model = register(labelled, "registered")
    folder = model.path.parent.parent
    for name, is_timed in (("registered", True), ("timed", True), ("resumable", False)):
        (folder / name).mkdir(exist_ok=True)
        record = RunRecord(fingerprint="", pretrained=False, note="", seconds=1.0, is_timed=is_timed)
        record.write(folder / name)
    (folder / ".dataset.part-x1").mkdir()
    run.remove_leftovers(labelled, DetectorKind.VIEW)
    assert {path.name for path in folder.iterdir()} >= {"registered", "resumable"}
    assert not (folder / "timed").exists()
    assert not (folder / ".dataset.part-x1").exists()


def test_parts_double_and_none_is_too_short() -> None:
    assert list(part_seconds(1.0)) == [60.0]
    assert list(part_seconds(3.0)) == [180.0]
    assert list(part_seconds(3.5)) == [210.0]
    assert list(part_seconds(30.0)) == [180.0, 360.0, 720.0, 540.0]
    assert sum(part_seconds(123.4)) == pytest.approx(60 * 123.4)


def test_only_the_object_of_a_view_is_labelled_and_the_start_gives_what_is_not_known(people: Project) -> None:
    recording = people.recordings.all()[0].id
    simulate_recording(people, recording, BoxKind.SILHOUETTE, RcvConfig(), every=2)
    given = Fixed((Box2D(WHOLE, 1.0, 1.0, 60.0, 60.0, 0.9), Box2D(WHOLE, 3.0, 3.0, 9.0, 9.0, 0.8)))
    samples = list(
        agnostic_samples(people, gather(people), RcvConfig(), SampleConfig(views=24), given, lambda *_: None)
    )
    assert {sample.origin for sample in samples} == {"drawn", "taught"}
    with_boxes = [sample for sample in samples if sample.boxes]
    assert len(with_boxes) > 0.7 * len(samples)
    for sample in with_boxes:
        assert sorted(box.label for box in sample.boxes) == [SEEN, WHOLE]
        assert next(box for box in sample.boxes if box.label == WHOLE) == given.boxes[0]


def test_the_confirmed_whole_box_is_taught_beside_the_silhouette(people: Project) -> None:
    recording = people.recordings.all()[0].id
    simulate_recording(people, recording, BoxKind.SILHOUETTE, RcvConfig(), every=5)
    drawn = people.boxes.on_views()
    image_boxes = [view.geometry.image_box for view in drawn if view.geometry is not None]
    frame_id = people.frames.of()[0].id
    frame = FrameSource(people).read(people.frames.get(frame_id))
    truth = visible_objects(open_recording(people.recordings.all()[0].path), 0, frame, ["person"])[0]
    image_box = image_box_of(frame, truth, BoxKind.SILHOUETTE)
    assert image_box in image_boxes
    new = NewLabel("person", truth.box, origin=Origin.DRAWN, image_box=image_box)
    people.labels.create(frame_id, [new], WriteContext(people.frames.get(frame_id).revision, "me"))
    given = Fixed((Box2D(WHOLE, 1.0, 1.0, 60.0, 60.0, 0.9), Box2D(SEEN, 2.0, 2.0, 50.0, 50.0, 0.9)))
    samples = list(
        agnostic_samples(people, gather(people), RcvConfig(), SampleConfig(views=24), given, lambda *_: None)
    )
    of_drawn = [sample for sample in samples if sample.origin == "drawn"]
    assert len(of_drawn) == len(image_boxes) == 12
    guessed = [given.boxes[0] in sample.boxes for sample in of_drawn]
    assert guessed == [known != image_box for known in image_boxes], "the start completes the other two objects only"
    for sample in of_drawn:
        boxes = {box.label: box for box in sample.boxes}
        if given.boxes[0] not in sample.boxes:
            seen, whole = boxes[SEEN], boxes[WHOLE]
            assert whole.width_px * whole.height_px > 0.9 * seen.width_px * seen.height_px
    taught = [sample for sample in samples if sample.origin == "taught" and len(sample.label_uids) == 2]
    assert taught and not any(set(sample.boxes) & set(given.boxes) for sample in taught)


def test_generated_views_are_about_the_share_that_was_asked_for() -> None:
    own = [TrainingSample(np.zeros((64, 64, 3), np.uint8), (), "1/1", "drawn")] * 100
    assert list(with_generated(own, 0.0, 64, 0)) == own
    samples, others = (list(with_generated(own, 0.5, 64, seed)) for seed in (0, 1))
    assert samples[:100] == own
    assert 50 < len(samples) - 100 < 200
    assert {sample.origin for sample in samples[100:]} == {"generated"}
    assert not {sample.group for sample in samples[100:]} & {sample.group for sample in others[100:]}


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

    monkeypatch.setattr(run, "train_detector", stop_at_training)
    monkeypatch.setattr(HeldOut, "mean_iou", lambda *_: 0.5)
    monkeypatch.setattr("annotator.workflows.training.train.load_detector", lambda path: Fixed())
    for role in DetectorKind:
        with pytest.raises(TrainingStoppedError):
            train(labelled, PLAN, roles=(role,))
    recording = labelled.recordings.all()[0].id
    for role in DetectorKind:
        assert sets[role]["val"] == {f"{recording}/{key}" for key in HELD_OUT}
        assert sets[role]["train"] == {f"{recording}/{number:06d}" for number in (0, 2, 4)}


@pytest.mark.slow
def test_a_round_continues_the_base_detector_for_the_time_it_is_given(labelled: Project, tmp_path: Path) -> None:
    install_base()
    network = build(NetworkDescription(architecture="yolo11n", labels=AGNOSTIC))
    write_network(base_detector.FOLDER / "detector.safetensors", network)
    plan = replace(PLAN, view=CONFIG.model_copy(update={"epochs": None}), minutes=0.2)
    begin = time.monotonic()
    (trained,) = train(labelled, plan, roles=(DetectorKind.VIEW,))
    assert time.monotonic() - begin > 5
    assert trained.decision is not None
    assert trained.decision.started_from == "starts from the base detector"
    stored = read_trained(trained.model.path.parent)
    assert (stored.classes, stored.kind) == (AGNOSTIC, BoxKind.BOX)
    assert stored.config.seconds == pytest.approx(10.0)
    origins = read_manifest(trained.model.path.parent).images_by_origin["train"]
    assert origins["generated"] > 0
    assert own_model(labelled, trained.model).class_agnostic


@pytest.mark.parametrize(
    ("changes", "anew"),
    [({}, [2]), ({"decides": False}, []), ({"minutes": 12.0}, []), ({"view": {"pretrained": "never"}}, [0, 1, 2, 3])],
)
def test_a_long_training_also_begins_anew_where_held_out_objects_decide(
    labelled: Project, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], anew: list[int]
) -> None:
    install_base()
    origins: list[UsedModel | None] = []

    def part(self: object, choice: Choice, origin: UsedModel | None, number: int, *_: object) -> None:
        origins.append(origin)
        if number == 3:
            raise TrainingStoppedError("enough")

    monkeypatch.setattr("annotator.workflows.training.train._ViewTraining._part", part)
    monkeypatch.setattr(HeldOut, "mean_iou", lambda *_: 0.5)
    view = CONFIG.model_copy(update={"epochs": None, **changes.pop("view", {})})
    with suppress(TrainingStoppedError, TypeError):
        train(labelled, replace(PLAN, view=view, **{"minutes": 60.0, **changes}), roles=(DetectorKind.VIEW,))
    assert len(origins) == (3 if "minutes" in changes else 4)
    assert [number for number, origin in enumerate(origins) if origin is None] == anew


def test_progress_counts_the_parts_and_the_time_of_a_run_with_a_fixed_duration() -> None:
    step = TrainingProgress(DetectorKind.VIEW, 2, 8, 0, 10, {}, None, None, 30.0, 90.0, "")
    assert step.share_done == 0.25
    assert replace(step, part=2, parts=2).share_done == 0.625
    # the number of epochs is only an estimate
    assert replace(step, epochs=100, is_timed=True).share_done == 0.25
    assert replace(step, epoch=8, seconds_left=0.0, is_timed=True).share_done == 1.0
