"""Held-out frames measure detectors, and teach none."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from view_detectors import HELD_OUT, PLAN, WHOLE, Fixed, held, install_base, write_model

from annotator.detection.config import TrainingConfig
from annotator.detection.dataset import read_manifest
from annotator.detection.trained import TrainedModel
from annotator.detection.training import TrainingStoppedError
from annotator.project import Project
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, Detector, DetectorKind, Frame, Image
from annotator.workflows.detectors import AGNOSTIC, Detectors, UsedModel
from annotator.workflows.training import held_out, run
from annotator.workflows.training.held_out import HeldOut
from annotator.workflows.training.samples import gather
from annotator.workflows.training.train import train


class AnyClass:
    """The boxes of another detector without their classes."""

    labels, fingerprint = AGNOSTIC, "any class"

    def __init__(self, detector: Detector) -> None:
        self._detector = detector

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [[replace(box, label=WHOLE) for box in boxes] for boxes in self._detector.detect(images)]


def test_the_reviewed_objects_of_held_out_frames_are_measured(
    labelled: Project, knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = held(labelled)
    assert (measured.frames, measured.decides) == (2, True)
    assert 5 <= measured.objects <= 6
    model = UsedModel(write_model(labelled.models_folder / "m"), BoxKind.BOX, True, "f")
    detectors: dict[str, Detector] = {"perfect": AnyClass(knowing("people").view), "blind": Fixed()}
    results = {}
    for name, detector in detectors.items():
        monkeypatch.setattr(held_out, "load_detector", lambda path, names=(), detector=detector: detector)
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

    monkeypatch.setattr(run, "train_detector", stop_at_training)
    monkeypatch.setattr(HeldOut, "mean_iou", lambda *_: 0.5)
    monkeypatch.setattr("annotator.workflows.training.train.load_detector", lambda path, names=(): Fixed())
    for role in DetectorKind:
        with pytest.raises(TrainingStoppedError):
            train(labelled, PLAN, roles=(role,))
    recording = labelled.recordings.all()[0].id
    for role in DetectorKind:
        assert sets[role]["val"] == {f"{recording}/{key}" for key in HELD_OUT}
        assert sets[role]["train"] == {f"{recording}/{number:06d}" for number in (0, 2, 4)}
