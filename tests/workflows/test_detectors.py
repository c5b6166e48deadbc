"""The project's detectors: clear errors if they are missing or unusable."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from annotator.project import Project
from annotator.project.classes import edit
from annotator.rcv.starts import is_warm
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import AnnotatorError, ConfigError, DetectionError
from annotator.workflows.detectors import active_detectors, load_detector, required_model
from annotator.workflows.warm_up import warm_up


def register(project: Project, role: DetectorKind, content: bytes = b"no weights") -> Path:
    weights = project.models_folder / role.value / "run" / "detector.pt"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(content)
    project.models.register(role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=role.value)
    return weights


def test_without_trained_detectors_the_error_names_the_command(people: Project) -> None:
    with pytest.raises(DetectionError, match="has no image detector yet; run `annotator train project0`"):
        active_detectors(people)
    register(people, DetectorKind.IMAGE)
    with pytest.raises(DetectionError, match="has no view detector yet"):
        active_detectors(people)


def test_weights_without_their_record_are_an_error(people: Project) -> None:
    for role in DetectorKind:
        register(people, role)
    with pytest.raises(AnnotatorError, match=r"model\.json: no such file"):
        active_detectors(people)


@pytest.mark.parametrize(("name", "value"), [("image_size_px", 7), ("threads", 0)])
def test_a_setting_out_of_range_is_named(tmp_path: Path, name: str, value: object) -> None:
    settings: dict[str, Any] = {"image_size_px": 96, name: value}
    with pytest.raises(ConfigError, match=f"detector setting {name}: .*, not {value!r}"):
        load_detector(tmp_path / "detector.pt", **settings)


def test_a_detector_follows_classes_that_were_changed_after_its_training(people: Project) -> None:
    register(people, DetectorKind.IMAGE)
    assert required_model(people, DetectorKind.IMAGE).names == ()
    people.change_classes(edit.RenameClass(name="person", new="human"), "ann")
    people.change_classes(edit.RenameClass(name="human", new="adult"), "ann")
    assert required_model(people, DetectorKind.IMAGE).names == (("person", "adult"),)
    people.change_classes(edit.AddClass(name="child"), "ann")
    people.change_classes(edit.RemoveClass(name="adult", with_boxes=True), "ann")
    assert required_model(people, DetectorKind.IMAGE).names == (("person", None),)


def test_objects_are_found_in_all_ways() -> None:
    found = [[is_warm(proposal) for proposal in result.proposals] for result in warm_up()]
    by_classes, class_agnostic = found[:4], found[4:]
    assert by_classes == [[False], [True]] * 2
    assert class_agnostic == [[False]] * 4
