"""Small runs of the demo, without and with training."""

from __future__ import annotations

import inspect
from pathlib import Path
from threading import Lock

import pytest

from annotator import demo
from annotator.demo import (
    GOOD_IOU,
    SAME_IOU,
    Plan,
    SimulatedOperator,
    run_first_drag,
    run_trained,
)
from annotator.detection import pretrained
from annotator.detection.perfect import NearestCluster
from annotator.formats.rcv import read_rcv
from annotator.project import REVIEWED, BoxRotation, Project, StoredFrame, WriteContext, open_project
from annotator.recordings import open_recording
from annotator.types import BoxKind, DetectorKind, ReviewState
from annotator.types.errors import ConfigError, DetectionError
from annotator.workflows.simulate import AUTHOR
from annotator.workflows.training.train import TrainPlan
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


@pytest.fixture
def clusters(monkeypatch: pytest.MonkeyPatch) -> None:
    view = ReadyDetector(NearestCluster("hand"), BoxKind.SILHOUETTE, Lock())
    monkeypatch.setattr(demo, "require_view", lambda _: view)
    monkeypatch.setattr(demo, "has_base", lambda: True)


@pytest.mark.usefixtures("clusters")
def test_one_drawn_box_per_object_becomes_reviewed_boxes_in_all_frames(tmp_path: Path) -> None:
    told: dict[str, list[float]] = {}
    seen: list[int] = []

    def on_proposals() -> None:
        with open_project(tmp_path / "demo") as project:
            seen.append(len(_labels(project, ReviewState.PROPOSED)))

    result = run_first_drag(
        tmp_path,
        Plan("hands", 3),
        lambda stage, done, of: told.setdefault(stage, []).append(done / of),
        on_proposals,
    )
    assert all(done[-1] == 1 for done in told.values())
    assert list(result.seconds) == ["generate", "first boxes", "follow and review", "export"]
    assert len(seen) == 1
    assert 0 < seen[0] <= result.reviewed.drawn, "the first proposals are there before they are reviewed"
    done = result.reviewed
    assert len(done.ious) == done.accepted + done.adjusted
    assert min(done.ious) >= SAME_IOU
    assert sum(iou >= GOOD_IOU for iou in done.ious) == done.accepted
    with open_project(tmp_path / "demo") as project:
        reviewed = _labels(project, *REVIEWED)
        assert _labels(project, ReviewState.PROPOSED) == []
        assert len(_labels(project, ReviewState.REJECTED)) == done.rejected
        # two hands in each of three frames
        assert len(reviewed) == done.boxes == 6
        assert len({label.track_id for label in reviewed}) < done.boxes, "boxes were followed"
        assert None not in {label.track_id for label in reviewed}
    counts = read_rcv(tmp_path / "3D_HAND").manifest.counts
    assert (counts.frames, counts.objects) == (3, 6)


def _labels(project: Project, *states: ReviewState) -> list:  # type: ignore[type-arg]
    return [stored.label for stored in project.labels.select(states=states)]


@pytest.mark.usefixtures("clusters")
@pytest.mark.parametrize("step", ["review", "draw", "place", "track"])
def test_a_frame_that_a_viewer_changes_meanwhile_is_left_to_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    context = SimulatedOperator._context

    def interfere(operator: SimulatedOperator, stored: StoredFrame) -> WriteContext:
        read, project = context(operator, stored), operator._project
        if inspect.stack()[1].function == step and stored.index == 0:
            project.boxes.set_on_image(stored.id, [], BoxKind.BOX, WriteContext(read.revision, "viewer"))
        return read

    monkeypatch.setattr(SimulatedOperator, "_context", interfere)
    result = run_first_drag(tmp_path, Plan("hands", 2), lambda *_: None)
    assert result.reviewed.boxes > 0
    with open_project(tmp_path / "demo") as project:
        last = project.frames.of()[-1]
        assert all(label.author == AUTHOR for label in project.labels.of_frame(last.id) if label.state in REVIEWED)


def test_existing_folders_are_not_overwritten(tmp_path: Path) -> None:
    there = "3D_HAND"
    (tmp_path / there).mkdir()
    with pytest.raises(ConfigError, match="exists already; choose another folder"):
        run_first_drag(tmp_path, Plan("hands", 4), lambda *_: None)
    assert [path.name for path in tmp_path.iterdir()] == [there]


def test_without_a_base_detector_the_error_names_the_other_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "none")
    with pytest.raises(DetectionError, match="--train"):
        run_first_drag(tmp_path, Plan("hands", 4), lambda *_: None)
    assert not list(tmp_path.iterdir())


STAGES = ["generate", "label", "train", "propose", "score and export"]


def tiny() -> TrainPlan:
    """The demo's trainings with 64 pixels and one epoch."""
    full = TRAINING()
    small = {"image_size_px": 64, "epochs": 1}
    return TrainPlan(full.image.model_copy(update=small), full.view.model_copy(update=small), full.samples)


TRAINING = demo._training


@pytest.mark.slow
def test_the_demo_runs_all_stages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "_training", tiny)
    told: dict[str, list[float]] = {}
    result = run_trained(
        tmp_path, Plan("hands", 4), lambda stage, done, of: told.setdefault(stage, []).append(done / of)
    )

    assert list(result.seconds) == STAGES
    assert {done[-1] for done in told.values()} == {1}

    assert (result.drawn.frames, result.drawn.boxes) == (2, 5 * result.drawn.objects)
    assert [each.role for each in result.trained] == [DetectorKind.IMAGE, DetectorKind.VIEW]
    assert (result.annotated.done, result.annotated.failed) == (4, [])
    ((name, scores),) = result.scores.content.model_dump()["classes"].items()
    assert (name, scores["objects"]) == ("hand", 4), "only the two unlabelled frames are scored"
    assert 0 <= scores["mean_iou"] <= 1

    assert len(open_recording(tmp_path / "recording")) == 4
    dataset = read_rcv(tmp_path / "3D_HAND")
    counts = dataset.manifest.counts
    assert (counts.frames, counts.objects) == (result.dataset.frames, result.dataset.objects)
    with open_project(tmp_path / "demo") as project:
        assert project.config.classes == ("hand",)
        assert project.config.settings.rotation is BoxRotation.FREE
        assert project.statistics().labels.total == dataset.manifest.counts.objects
        assert project.problems() == []
