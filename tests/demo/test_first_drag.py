"""A small run of the demo without training: one drawn box per object becomes a reviewed box in every frame."""

from __future__ import annotations

from pathlib import Path
from threading import Lock

import pytest

from annotator.demo import first_drag
from annotator.demo.first_drag import FirstDragPlan, run_first_drag
from annotator.demo.reviewing import GOOD_IOU, SAME_IOU
from annotator.detection import base_detector
from annotator.detection.nearest_cluster import NearestCluster
from annotator.formats.rcv import read_rcv
from annotator.project import REVIEWED, Project, open_project
from annotator.types import BoxKind, ReviewState
from annotator.types.errors import ConfigError, DetectionError
from annotator.workflows.workbench.loaded_detectors import ReadyDetector


@pytest.fixture
def clusters(monkeypatch: pytest.MonkeyPatch) -> None:
    view = ReadyDetector(NearestCluster("hand"), BoxKind.SILHOUETTE, Lock())
    monkeypatch.setattr(first_drag, "require_view", lambda _: view)
    monkeypatch.setattr(first_drag, "has_base", lambda: True)


@pytest.mark.usefixtures("clusters")
def test_one_drawn_box_per_object_becomes_reviewed_boxes_in_all_frames(tmp_path: Path) -> None:
    told: dict[str, list[float]] = {}
    seen: list[int] = []

    def on_proposals() -> None:
        with open_project(tmp_path / "demo") as project:
            seen.append(len(_labels(project, ReviewState.PROPOSED)))

    result = run_first_drag(
        tmp_path,
        FirstDragPlan(preset="hands", frames=4),
        lambda stage, done, of: told.setdefault(stage, []).append(done / of),
        on_proposals,
    )
    assert list(told) == ["ray-cast the recording", "draw, follow and review", "write the dataset"]
    assert all(done[-1] == 1 for done in told.values())
    assert list(result.seconds) == ["generate", "first boxes", "follow and review", "export"]
    assert seen == [result.reviewed.drawn] or sum(seen) > 0, "the first proposals are there before they are reviewed"
    done = result.reviewed
    assert len(done.ious) == done.accepted + done.adjusted
    assert min(done.ious) >= SAME_IOU
    assert sum(iou >= GOOD_IOU for iou in done.ious) == done.accepted
    with open_project(tmp_path / "demo") as project:
        reviewed = _labels(project, *REVIEWED)
        assert _labels(project, ReviewState.PROPOSED) == []
        assert len(_labels(project, ReviewState.REJECTED)) == done.rejected
        # two hands in each of four frames
        assert len(reviewed) == done.boxes == 8
        assert len({label.track_id for label in reviewed}) < done.boxes, "boxes were followed"
        assert None not in {label.track_id for label in reviewed}
    counts = read_rcv(tmp_path / "3D_HAND").manifest.counts
    assert (counts.frames, counts.objects) == (4, 8)


def _labels(project: Project, *states: ReviewState) -> list:  # type: ignore[type-arg]
    return [stored.label for stored in project.labels.select(states=states)]


@pytest.mark.parametrize("there", ["recording", "demo", "3D_HAND"])
def test_existing_folders_are_not_overwritten(tmp_path: Path, there: str) -> None:
    (tmp_path / there).mkdir()
    with pytest.raises(ConfigError, match="exists already; choose another folder"):
        run_first_drag(tmp_path, FirstDragPlan(preset="hands", frames=4), lambda *_: None)
    assert [path.name for path in tmp_path.iterdir()] == [there]


def test_without_a_base_detector_the_error_names_the_other_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(base_detector, "FOLDER", tmp_path / "none")
    with pytest.raises(DetectionError, match="--train"):
        run_first_drag(tmp_path, FirstDragPlan(preset="hands", frames=4), lambda *_: None)
    assert not list(tmp_path.iterdir())
