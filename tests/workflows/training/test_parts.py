"""The parts of a training: how long they are, and which of them begins anew."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pytest
from view_detectors import CONFIG, PLAN, install_base, register

from annotator.detection import pretrained
from annotator.detection.dataset import read_manifest
from annotator.detection.trained import read_trained
from annotator.detection.training import TrainingProgress
from annotator.detection.weights import NetworkDescription, build, write_network
from annotator.project import Project
from annotator.types import BoxKind, DetectorKind
from annotator.workflows.detectors import AGNOSTIC, UsedModel, own_model
from annotator.workflows.training.held_out import Decision, HeldOut
from annotator.workflows.training.rounds import Choice, part_seconds
from annotator.workflows.training.run import Ran
from annotator.workflows.training.train import train


def test_parts_double_and_none_is_too_short() -> None:
    assert list(part_seconds(1.0)) == [60.0]
    assert list(part_seconds(3.0)) == [180.0]
    assert list(part_seconds(3.5)) == [210.0]
    assert list(part_seconds(30.0)) == [180.0, 360.0, 720.0, 540.0]
    assert sum(part_seconds(123.4)) == pytest.approx(60 * 123.4)


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
    origins = read_manifest(trained.model.path.parent).images_by_origin["train"]
    assert origins["generated"] > 0
    assert own_model(labelled, trained.model).class_agnostic


@pytest.mark.parametrize(
    ("changes", "pretrained", "parts", "anew"),
    [
        ({}, "auto", 5, [2]),
        ({"decides": False}, "auto", 5, []),
        ({"minutes": 12.0}, "auto", 3, []),
        # after the first part, each continues the best one so far
        ({}, "never", 5, [0]),
    ],
)
def test_a_long_training_also_begins_anew_where_held_out_objects_decide(
    labelled: Project,
    monkeypatch: pytest.MonkeyPatch,
    changes: dict[str, Any],
    pretrained: str,
    parts: int,
    anew: list[int],
) -> None:
    install_base()
    origins: list[UsedModel | None] = []

    def part(self: object, choice: Choice, origin: UsedModel | None, number: int, *_: object) -> tuple[Ran, Decision]:
        origins.append(origin)
        model = register(labelled, f"part{number}")
        folder = model.path.parent
        return Ran(model, read_trained(folder), read_manifest(folder)), choice.add(model, "")

    monkeypatch.setattr("annotator.workflows.training.train._ViewTraining._part", part)
    monkeypatch.setattr(HeldOut, "mean_iou", lambda *_: 0.5)
    view = CONFIG.model_copy(update={"epochs": None, "pretrained": pretrained})
    (trained,) = train(labelled, replace(PLAN, view=view, **{"minutes": 60.0, **changes}), roles=(DetectorKind.VIEW,))
    assert trained.model.fingerprint == f"part{parts - 1}"
    assert len(origins) == parts
    assert [number for number, origin in enumerate(origins) if origin is None] == anew


def test_progress_counts_the_parts_and_the_time_of_a_run_with_a_fixed_duration() -> None:
    step = TrainingProgress(DetectorKind.VIEW, 2, 8, 0, 10, {}, None, None, 30.0, 90.0, "")
    assert step.share_done == 0.25
    assert replace(step, part=2, parts=2).share_done == 0.625
    # the number of epochs is only an estimate
    assert replace(step, epochs=100, is_timed=True).share_done == 0.25
    assert replace(step, epoch=8, seconds_left=0.0, is_timed=True).share_done == 1.0
