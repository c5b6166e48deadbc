"""Boxes around a vehicle, of nuScenes' results and Argoverse 2's annotations, go to the cameras that see them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from argoverse_samples import CAMERAS as LOG_CAMERAS
from argoverse_samples import write_log
from nuscenes_samples import CAMERAS, real, small

from annotator.geometry.oriented_box import box_corners
from annotator.project import Project
from annotator.recordings import ReaderOptions, Recording, open_recording
from annotator.types.errors import FormatError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.importing import BoxFormat, Note, format_of, import_labels, import_proposals, read_labels
from annotator.workflows.importing.values import add_attributes, values_of_labels
from annotator.workflows.recorded.reading import load_truth


def results(path: Path, tables: Path, task: str = "detection", **more: Any) -> Path:
    """The annotations of a dataset as the results of a detector, the scores of a sample's boxes rising from 0."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in json.loads((tables / "sample_annotation.json").read_text()):
        boxes = found.setdefault(row["sample_token"], [])
        box = {key: row[key] for key in ("sample_token", "translation", "size", "rotation")}
        named = {f"{task}_name": row.get("instance_class", "car"), f"{task}_score": len(boxes) / 100}
        boxes.append(box | {"velocity": [0.0, 0.1]} | named | more)
    path.write_text(json.dumps({"meta": {"use_lidar": True}, "results": found | {"elsewhere": []}}))
    return path


def added(project: Project, path: Path, **options: str) -> Recording:
    chosen = ReaderOptions(**options)
    register_recording(project, open_recording(path, chosen), options=chosen)
    return open_recording(path, chosen)


@pytest.mark.shared
def test_results_of_the_real_sample_are_its_boxes_in_every_camera(
    make_project: Callable[..., Project], shared: Path, tmp_path: Path
) -> None:
    names = real(shared / "data" / "nuscenes_frame", tmp_path / "set")["sample"]["images"]
    classes = sorted(
        {row["instance_class"] for row in json.loads((tmp_path / "set/v1.0-mini/sample_annotation.json").read_text())}
    )
    project = make_project(classes=classes)
    recordings = [added(project, tmp_path / "set", camera=name) for name in names]
    path = results(tmp_path / "results.json", tmp_path / "set" / "v1.0-mini", attribute_name="vehicle.moving")
    assert format_of(path) is BoxFormat.NUSCENES
    done = import_proposals(project, read_labels(BoxFormat.NUSCENES, path), min_score=0.1)
    assert (done.source, done.frames, tuple(done.of(Note.UNMATCHED))) == ("results", 6, ("elsewhere",))
    assert done[Note.UNSURE] > 0 and done.boxes.total() > 50
    proposed = {}
    for frame, recording in zip(project.frames.of(), recordings, strict=True):
        truths = load_truth(recording, 0, recording.frame(0))
        labels = project.labels.of_frame(frame.id)
        proposed[recording.name] = len(labels)
        for label in labels:
            near = [np.abs(box_corners(each.box) - box_corners(label.box)).max() for each in truths]
            best = truths[int(np.argmin(near))]
            assert min(near) < 1e-6 and best.label == label.label and label.score is not None and label.score >= 0.1
    assert sum(proposed.values()) == done.boxes.total()


@pytest.mark.parametrize("task", ["detection", "tracking"])
def test_results_find_their_frames_and_trackers_their_tracks(
    make_project: Callable[..., Project], tmp_path: Path, task: str
) -> None:
    data = small(tmp_path / "set")
    project = make_project(classes=("car",))
    tables = next(data.glob("v1.0-*"))
    path = results(tmp_path / "theirs.json", tables, task, **({"tracking_id": "a7"} if task == "tracking" else {}))
    with pytest.raises(FormatError, match=r"none of its samples \(\d\); add their scenes"):
        import_proposals(project, read_labels(BoxFormat.NUSCENES, path))
    added(project, data, scene="scene-0000", camera=CAMERAS[0])
    done = import_proposals(project, read_labels(BoxFormat.NUSCENES, path))
    # two samples of the six frames; the box of the other camera is not in its image
    assert (done.frames, done.boxes) == (2, {"car": 2})
    stored = project.labels.select()
    assert {each.label.track_id for each in stored} == ({0} if task == "tracking" else {None})
    assert done[Note.UNSEEN] == 2
    # as labels, on frames without any, and as 2D boxes
    labelled = make_project(classes=("car",))
    added(labelled, data, scene="scene-0000", camera=CAMERAS[1])
    assert len(read_labels(BoxFormat.NUSCENES, path).in_project(labelled).placed(labelled).matched) == 2
    imported = import_labels(labelled, read_labels(BoxFormat.NUSCENES, path))
    assert (imported.boxes, imported[Note.UNSEEN]) == ({"car": 2}, 2)
    # no box is outside both cameras
    added(project, data, scene="scene-0000", camera=CAMERAS[1])
    assert import_proposals(project, read_labels(BoxFormat.NUSCENES, path))[Note.UNSEEN] == 0


def test_attributes_of_results_can_be_added_to_the_project(
    make_project: Callable[..., Project], tmp_path: Path
) -> None:
    data = small(tmp_path / "set")
    project = make_project(classes=("car",))
    added(project, data, scene="scene-0000", camera=CAMERAS[0])
    path = results(tmp_path / "theirs.json", next(data.glob("v1.0-*")), attribute_name="vehicle.moving")
    dataset = read_labels(BoxFormat.NUSCENES, path)
    assert import_proposals(project, dataset).of(Note.VALUE) == {"vehicle (not an attribute of the project)": 2}
    assert [each.name for each in add_attributes(project, values_of_labels(dataset))] == ["vehicle"]
    assert not import_proposals(project, dataset)[Note.VALUE]
    assert {each.label.attributes["vehicle"] for each in project.labels.select()} == {"moving"}


AHEAD, BEHIND = "REGULAR_VEHICLE", "PEDESTRIAN"


def test_annotations_are_placed_like_the_recordings_own(make_project: Callable[..., Project], tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", sweeps=3)
    file = write_log(tmp_path / "theirs", sweeps=4, images=False) / "annotations.feather"
    assert format_of(file) is format_of(file.parent) is BoxFormat.ARGOVERSE2
    project = make_project(classes=(AHEAD, BEHIND))
    with pytest.raises(FormatError, match=r"none of its sweeps \(4\); add their log"):
        import_labels(project, read_labels(BoxFormat.ARGOVERSE2, file))
    recordings = [open_recording(log, ReaderOptions(camera=camera)) for camera in LOG_CAMERAS]
    register_recording(project, recordings[0], options=ReaderOptions(camera=next(iter(LOG_CAMERAS))))
    done = import_labels(project, read_labels(BoxFormat.ARGOVERSE2, file))
    # the front camera sees one of the two boxes of each sweep
    assert (done.frames, done.boxes, done[Note.UNSEEN], len(tuple(done.of(Note.UNMATCHED)))) == (3, {AHEAD: 3}, 3, 1)
    for number, stored in enumerate(project.frames.of()):
        (label,) = project.labels.of_frame(stored.id)
        (own,) = load_truth(recordings[0], number, recordings[0].frame(number))
        np.testing.assert_allclose(box_corners(label.box), box_corners(own.box), atol=1e-9)
        assert (label.label, label.track_id) == (own.label, own.track_id)
    register_recording(project, recordings[1], options=ReaderOptions(camera=list(LOG_CAMERAS)[1]))
    proposed = import_proposals(project, read_labels(BoxFormat.ARGOVERSE2, file.parent))
    assert (proposed.frames, proposed.boxes, proposed[Note.COVERED], proposed[Note.UNSEEN]) == (6, {BEHIND: 3}, 3, 0)
