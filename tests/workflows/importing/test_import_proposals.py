"""3D boxes of other software, in every format, become proposals, onto frames with labels as well."""

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

from annotator.formats.sunrgbd import read_extracted_folder
from annotator.geometry.oriented_box import box_corners
from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import ReaderOptions, Recording, open_recording
from annotator.recordings.sunrgbd import read_extracted_calibration
from annotator.types import OrientedBox, ReviewState, Source
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.importing import (
    BoxFormat,
    ImportReport,
    Note,
    format_of,
    import_labels,
    import_proposals,
    read_labels,
)
from annotator.workflows.importing.values import add_attributes, values_of_labels
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.workbench.review_queue import Order, queue


def box(x: float) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.2, 3.0]), np.eye(3), np.array([0.5, 0.4, 1.8]))


def boxes_file(path: Path, frames: dict[str, list[tuple[Any, ...]]]) -> Path:
    """A `boxes.json` with class, x, score (None: without) and, if given, track of each box."""
    entry = {"size": [0.5, 0.4, 1.8], "rotation": np.eye(3).tolist()}

    def fields(label: str, x: float, score: float | None, track: int | None = None) -> dict[str, Any]:
        more = {name: value for name, value in (("score", score), ("track", track)) if value is not None}
        return entry | {"label": label, "center": [x, 0.2, 3.0]} | more

    path.write_text(json.dumps({key: [fields(*each) for each in boxes] for key, boxes in frames.items()}))
    return path


# Argoverse 2 is not exported: see below
@pytest.mark.parametrize("format", [each for each in BoxFormat if each is not BoxFormat.ARGOVERSE2])
def test_boxes_of_every_format_become_proposals_onto_labelled_frames(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path, format: BoxFormat
) -> None:
    frame = people.frames.of()[1]
    people.labels.create(frame.id, [NewLabel("person", box(0.0), 0.7)], WriteContext(0, "me"))
    if format is BoxFormat.BOXES:
        path = boxes_file(tmp_path / "theirs.json", {frame.key: [("person", 0.0, 0.7)]})
    elif format is BoxFormat.BOX_CSV:
        path = box_csv(people, tmp_path)
    else:
        path = tmp_path / "theirs"
        export_project(people, path, ExportFormat(format))
    other = make_project(generated / "people")
    mine = other.labels.create(other.frames.of()[1].id, [NewLabel("person", box(5.0))], WriteContext(0, "me")).uids
    assert format_of(path) is format
    done = import_proposals(other, read_labels(format, path))
    assert (done.source, done.frames, done.boxes) == ("theirs", 1, {"person": 1})
    accepted, proposed = other.labels.select()
    assert (accepted.label.uid, accepted.label.state) == (mine[0], ReviewState.ACCEPTED)
    assert (proposed.label.state, proposed.label.source) == (ReviewState.PROPOSED, Source.IMPORTED)
    assert [(each.source, each.score) for each in proposed.said] == [("theirs", proposed.label.score)]
    # some formats hold upright boxes only
    np.testing.assert_allclose(proposed.label.box.center_m, box(0.0).center_m, atol=0.01)


def box_csv(project: Project, folder: Path, score: float = 0.7) -> Path:
    """The labels of a project as rows; their numbers are those of its export as SUN RGB-D."""
    export_project(project, folder / "upright", ExportFormat.SUNRGBD)
    rows = ["image,class,cx,cy,cz,l,w,h,yaw,score"]
    for name, frame in read_extracted_folder(
        folder / "upright", lambda file: read_extracted_calibration(file).T_camera_upright
    ).items():
        for each in frame.truths:
            yaw = np.arctan2(*each.box.rotation[1::-1, 0])
            numbers = (*each.box.center_m, *each.box.size_m, yaw, score)
            rows.append(",".join((name, each.label, *map(str, numbers))))
    (folder / "theirs.csv").write_text("\n".join(rows))
    return folder / "theirs.csv"


def test_proposals_of_an_rcv_export_come_in_and_rejected_boxes_do_not(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    frame = people.frames.of()[1]
    theirs = boxes_file(tmp_path / "b", {frame.key: [("person", 0.0, 0.4)]})
    import_proposals(people, read_labels(BoxFormat.BOXES, theirs))
    revision = people.frames.get(frame.id).revision
    rejected = NewLabel("person", box(3.0), state=ReviewState.REJECTED)
    people.labels.create(frame.id, [rejected], WriteContext(revision, "me"))
    every = ExportFilter(states=tuple(ReviewState))
    for format in (ExportFormat.RCV, ExportFormat.OPENLABEL):
        export_project(people, tmp_path / format, format, choose=every)
        other = make_project(generated / "people")
        dataset = read_labels(format_of(tmp_path / format), tmp_path / format)  # type: ignore[arg-type]
        done = import_proposals(other, dataset)
        assert (done.boxes, done[Note.REJECTED]) == ({"person": 1}, 1)
        assert dataset.classes(dataset.frames[0]) == ["person"]
        assert [entry.label.score for entry in other.labels.select()] == [0.4]


def test_several_detectors_stay_side_by_side_and_the_queue_shows_the_worst_first(
    people: Project, tmp_path: Path
) -> None:
    first, second, third = people.frames.of()[:3]
    one = boxes_file(
        tmp_path / "one.json",
        {first.key: [("Car", 0.0, 0.9), ("dog", 2.0, 0.9)], second.key: [("person", 0.0, 0.05), ("person", 3.0, 0.6)]},
    )
    two = boxes_file(
        tmp_path / "two.json", {first.key: [("person", 0.05, 3.5)], third.key: [("person", 0.0, -1.0)], "gone": []}
    )
    done = import_proposals(people, read_labels(BoxFormat.BOXES, one), min_score=0.1, names={"Car": "person"})
    assert (done.frames, done.boxes, done[Note.UNSURE], done.of(Note.OTHER_CLASS)) == (2, {"person": 2}, 1, {"dog": 1})
    for source in (" ", "annotator", "x" * 201):
        with pytest.raises(ConfigError, match="cannot name a source of boxes"):
            import_proposals(people, read_labels(BoxFormat.BOXES, two), source)
    done = import_proposals(people, read_labels(BoxFormat.BOXES, two), "second detector")
    assert (done.source, done[Note.MERGED], tuple(done.of(Note.UNMATCHED))) == ("second detector", 1, ("gone",))
    assert list(done.of(Note.SCALED)) == ["-1 to 3.5"]
    items = queue(people, Order.WORST).items
    assert [(item.frame.key, round(item.doubt or 0.0, 2)) for item in items] == [
        (third.key, 0.7),
        (second.key, 0.28),
        (first.key, 0.0),
    ]
    (merged,) = [people.labels.get(item.uid or "") for item in items if item.frame.key == first.key]
    assert [(each.source, each.score) for each in merged.said] == [("second detector", 1.0), ("one", 0.9)]
    # the second import of a source replaces the first, and a finalised frame stays as it is
    people.frames.finalise(second.id, WriteContext(people.frames.get(second.id).revision, "me"))
    again = boxes_file(tmp_path / "one.json", {first.key: [], second.key: [], third.key: []})
    done = import_proposals(people, read_labels(BoxFormat.BOXES, again))
    assert (done.frames, done[Note.FINALISED]) == (2, 1)
    assert [[each.source for each in entry.said] for entry in people.labels.select()] == [
        ["second detector"],
        ["one"],
        ["second detector"],
    ]


def tracked(path: Path, frames: dict[str, list[tuple[float, int]]], score: float = 0.9) -> Path:
    """A `boxes.json` with x and track id of each box."""
    return boxes_file(path, {key: [("person", x, score, track) for x, track in each] for key, each in frames.items()})


def tracks_by_place(project: Project) -> dict[float, set[int | None]]:
    found: dict[float, set[int | None]] = {}
    for stored in project.labels.select(states=[ReviewState.PROPOSED]):
        found.setdefault(float(stored.label.box.center_m[0]), set()).add(stored.label.track_id)
    return found


def test_a_later_file_of_a_source_keeps_the_ids_that_its_tracks_got(people: Project, tmp_path: Path) -> None:
    first, second = people.frames.of()[:2]
    people.labels.create(first.id, [NewLabel("person", box(20.0), track_id=1)], WriteContext(0, "me"))
    path = tracked(tmp_path / "det.json", {first.key: [(0.0, 1)]})
    import_proposals(people, read_labels(BoxFormat.BOXES, path))
    assert tracks_by_place(people) == {0.0: {2}}
    # the second half of the recording; the id that the first half's track got is another track's in the file
    tracked(path, {second.key: [(5.0, 2), (0.0, 1)]})
    import_proposals(people, read_labels(BoxFormat.BOXES, path))
    assert tracks_by_place(people) == {0.0: {2}, 5.0: {3}}


def test_a_track_that_needs_another_id_does_not_get_one_of_the_same_file(people: Project, tmp_path: Path) -> None:
    first, second = people.frames.of()[:2]
    people.labels.create(first.id, [NewLabel("person", box(30.0), track_id=1)], WriteContext(0, "me"))
    frames = {first.key: [(0.0, 1), (10.0, 2)], second.key: [(0.0, 1), (10.0, 2), (20.0, 3)]}
    for name in ("one", "one", "two"):
        import_proposals(people, read_labels(BoxFormat.BOXES, tracked(tmp_path / f"{name}.json", frames)))
        ids = [track for tracks in tracks_by_place(people).values() for track in tracks]
        assert len(ids) == len({*ids}) == 3 and 1 not in ids


def test_ids_that_other_sources_use_are_not_used_again_although_both_see_the_object(
    people: Project, tmp_path: Path
) -> None:
    first, second = people.frames.of()[:2]
    one = tracked(tmp_path / "one.json", {first.key: [(0.0, 3)]})
    two = tracked(tmp_path / "two.json", {first.key: [(0.0, 8)]}, 0.5)
    three = tracked(tmp_path / "three.json", {second.key: [(9.0, 8)]})
    for path in (one, two, three):
        import_proposals(people, read_labels(BoxFormat.BOXES, path))
    # the track of the hidden box is its source's
    assert tracks_by_place(people) == {0.0: {3}, 9.0: {9}}
    import_proposals(people, read_labels(BoxFormat.BOXES, tracked(two, {second.key: [(5.0, 3)]}, 0.5)))
    assert tracks_by_place(people) == {0.0: {3}, 5.0: {10}, 9.0: {9}}
    import_proposals(people, read_labels(BoxFormat.BOXES, tracked(one, {first.key: []})))
    assert tracks_by_place(people) == {0.0: {8}, 5.0: {10}, 9.0: {9}}


@pytest.mark.parametrize("run", [import_labels, import_proposals])
def test_a_track_that_a_file_has_twice_in_a_frame_is_kept_once_and_counted(
    people: Project, tmp_path: Path, run: Callable[..., ImportReport]
) -> None:
    first, second = people.frames.of()[:2]
    path = tracked(tmp_path / "theirs.json", {first.key: [(0.0, 7), (1.0, 7), (2.0, 7)], second.key: [(0.0, 7)]})
    done = run(people, read_labels(BoxFormat.BOXES, path))
    assert done[Note.TRACK] == 2
    tracks = [[label.track_id for label in people.labels.of_frame(frame.id)] for frame in (first, second)]
    assert tracks == [[7, None, None], [7]]


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
        labels = [each.label for each in project.labels.of_moment(frame.id) if each.is_own]
        proposed[recording.name] = len(labels)
        for label in labels:
            near = [np.abs(box_corners(each.box) - box_corners(label.box)).max() for each in truths]
            best = truths[int(np.argmin(near))]
            assert min(near) < 1e-6 and best.label == label.label and label.score is not None and label.score >= 0.1
    # an object that several cameras see is one
    assert sum(proposed.values()) == done.boxes.total() == len(project.labels.of_frame(1)) and done[Note.COVERED] > 0


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
