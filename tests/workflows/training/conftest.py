"""Fixtures: a project with held-out frames, and detectors whose measurement is given."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from view_detectors import HELD_OUT

from annotator.detection import pretrained
from annotator.project import Project
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.simulate import simulate_recording
from annotator.workflows.training import held_out
from annotator.workflows.training.held_out import HeldOut


def fill(project: Project) -> None:
    (recording,) = project.recordings.all()
    import_own_labels(project, recording.id)
    simulate_recording(project, recording.id, BoxKind.BOX, RcvConfig(), every=1)


@pytest.fixture
def labelled(prepared: Callable[..., Project], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Project:
    """The project with the true boxes of all 5 frames and drawn views; two of the frames are held out.

    The folder of the base detector is the test's own, and empty.
    """
    project = prepared("labelled", fill)
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "base")
    recording = project.recordings.all()[0].id
    monkeypatch.setattr(held_out, "is_held_out", {f"{recording}/{key}" for key in HELD_OUT}.__contains__)
    return project


@pytest.fixture
def ious(monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """The measured mean IoU of each detector by fingerprint, in place of a measurement."""
    table: dict[str, float] = {}
    monkeypatch.setattr(HeldOut, "mean_iou", lambda self, model: table[model.fingerprint])
    return table
