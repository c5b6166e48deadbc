"""After each part of a training, held-out frames decide which view detector is used."""

from __future__ import annotations

import pytest
from view_detectors import CONFIG, held, install_base, register

from annotator.project import Project
from annotator.types import DetectorKind
from annotator.workflows.detectors import base_model, own_model, used_model
from annotator.workflows.training.held_out import read_decision
from annotator.workflows.training.rounds import Choice, choose_start


def choice_of(project: Project, objects: int = 6, **changes: str) -> Choice:
    """The choice of a training with these settings that begins now."""
    measured = held(project, objects)
    return Choice(project, measured, choose_start(project, measured, CONFIG.model_copy(update=changes)))


def test_a_detector_from_random_weights_is_used_only_if_it_is_better(labelled: Project, ious: dict[str, float]) -> None:
    active = register(labelled, "a", active=True)
    ious.update(a=0.6, worse=0.3, better=0.7)
    choice = choice_of(labelled, pretrained="never")
    assert choice.start.model is None
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
        assert read_decision(model.path.parent) == decision
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


@pytest.mark.parametrize("has_base", [True, False])
def test_below_five_held_out_objects_the_base_detector_stays(
    labelled: Project, ious: dict[str, float], has_base: bool
) -> None:
    if has_base:
        install_base()
    choice = choice_of(labelled, 0)
    assert not choice.held_out.decides
    decision = choice.add(register(labelled, "new"), "")
    used = used_model(labelled, DetectorKind.VIEW)
    assert used is not None
    assert used.fingerprint == ("base detector" if has_base else "new")
    assert decision.mean_iou is None
    assert "fewer than 5 reviewed objects" in decision.outcome


def test_below_five_held_out_objects_an_own_detector_stays_in_use(labelled: Project, ious: dict[str, float]) -> None:
    install_base()
    active = register(labelled, "a", active=True)
    assert choice_of(labelled, 0).add(register(labelled, "new"), "").outcome.endswith("what was in use stayed in use")
    assert labelled.models.get(active.id).active
