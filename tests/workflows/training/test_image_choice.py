"""Whether a new image detector is used: held-out images decide."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from view_detectors import Fixed

from annotator.detection.dataset import DatasetManifest, TrainingSample, write_dataset
from annotator.project import Project, StoredModel
from annotator.types import Box2D, BoxKind, DetectorKind
from annotator.workflows.training import image_choice
from annotator.workflows.training.image_choice import decide, matched_ious

PERSON, HALF = Box2D("person", 10.0, 20.0, 40.0, 60.0, 0.9), Box2D("person", 10.0, 20.0, 25.0, 60.0, 0.9)
FALSE = Box2D("person", 60.0, 5.0, 75.0, 15.0, 0.9)


def test_pairs_are_matched_once_and_the_others_count_as_zero() -> None:
    assert matched_ious([PERSON], [HALF, PERSON, FALSE]) == [1.0, 0.0, 0.0]
    assert matched_ious([PERSON, PERSON], [HALF]) == [pytest.approx(0.5, abs=0.02), 0.0]
    assert matched_ious([PERSON], [Box2D("dog", 10.0, 20.0, 40.0, 60.0, 0.9)]) == [0.0, 0.0]
    assert matched_ious([], []) == []


@pytest.mark.parametrize(
    ("images", "used", "new", "outcome", "is_used"),
    [
        (5, None, (PERSON,), "put into use", True),
        (5, (HALF,), (PERSON,), "the best one on held-out images: put into use", True),
        (5, (PERSON,), (PERSON, FALSE), "worse on held-out images: not put into use, and the one in use stayed", False),
        (5, None, (FALSE,), "it finds none of the reviewed objects on held-out frames: not put into use", False),
        (5, (FALSE,), (), "it finds none of the reviewed objects on held-out frames: not put into use, and the", False),
        (4, (PERSON,), (), "fewer than 5 objects on held-out images: put into use as the newest", True),
    ],
)
def test_a_worse_detector_or_one_that_finds_nothing_is_not_used(
    people: Project,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    images: int,
    used: tuple[Box2D, ...] | None,
    new: tuple[Box2D, ...],
    outcome: str,
    is_used: bool,
) -> None:
    grey = np.full((80, 100, 3), 100, np.uint8)
    samples = [TrainingSample(grey, (PERSON,), str(number), "drawn") for number in range(images + 1)]
    manifest = write_dataset(tmp_path / "set", samples, ("person",), lambda group: group != "0", BoxKind.BOX)
    finds = {"old": used, "new": new}
    load = lambda path, names=(): Fixed(finds[path.parent.name] or (), labels=("person",))  # noqa: E731
    monkeypatch.setattr(image_choice, "load_detector", load)
    before = None if used is None else _register(people, "old", manifest, active=True)
    model = _register(people, "new", manifest, active=False)
    decision = decide(people, tmp_path / "set", manifest, model, "")
    assert decision.outcome.startswith(outcome)
    assert (decision.objects, decision.frames, decision.mean_iou is None) == (images, images, images < 5)
    assert people.models.active(DetectorKind.IMAGE) == (people.models.get(model.id) if is_used else before)


def _register(project: Project, name: str, learned: DatasetManifest, *, active: bool) -> StoredModel:
    folder = project.models_folder / "image" / name
    folder.mkdir(parents=True)
    (folder / "detector.safetensors").write_bytes(b"weights")
    (folder / "manifest.json").write_text(learned.model_dump_json())
    return project.models.register(
        DetectorKind.IMAGE, folder / "detector.safetensors", labels=("person",), box_kind=BoxKind.BOX, metrics={},
        fingerprint=name, activate=active, manifest=folder / "manifest.json",
    )  # fmt: skip
