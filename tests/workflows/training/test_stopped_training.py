"""Trainings that are stopped or killed."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from view_detectors import PLAN, Fixed, held, register

from annotator.detection.dataset import TrainingSample
from annotator.detection.trained import RunRecord
from annotator.detection.training import TrainingStoppedError
from annotator.project import Project
from annotator.types import DetectorKind
from annotator.workflows.detectors import Detectors, own_model
from annotator.workflows.training import held_out, run
from annotator.workflows.training.train import train


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

    monkeypatch.setattr(held_out, "load_detector", lambda path, names=(): Fixed())
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
