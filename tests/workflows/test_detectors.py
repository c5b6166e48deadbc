"""The project's detectors: clear words where there is none, or none that can be used."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.project import Project, Role
from annotator.types import BoxKind
from annotator.types.errors import AnnotatorError, DetectionError
from annotator.workflows.detectors import active_detectors, load_detector


def register(project: Project, role: Role, content: bytes = b"no weights") -> Path:
    weights = project.models_folder / role.value / "run" / "detector.pt"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(content)
    project.models.register(role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=role.value)
    return weights


def test_nothing_trained_yet(people: Project) -> None:
    with pytest.raises(DetectionError, match="has no image detector yet; run `annotator train project0`"):
        active_detectors(people)
    register(people, Role.IMAGE)
    with pytest.raises(DetectionError, match="has no view detector yet"):
        active_detectors(people)


def test_weights_without_their_record(people: Project) -> None:
    for role in Role:
        register(people, role)
    with pytest.raises(AnnotatorError, match=r"model\.json: no such file"):
        active_detectors(people)


def test_weights_that_are_gone(people: Project) -> None:
    weights = register(people, Role.IMAGE)
    weights.unlink()
    with pytest.raises(AnnotatorError, match="run"):
        load_detector(weights)
