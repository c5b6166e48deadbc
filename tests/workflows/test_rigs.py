"""Rigs: the cameras of one moment share its labels; recordings in map coordinates."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_samples import OBJECT_CALIB
from nuscenes_samples import real, small
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners
from annotator.project import BoxRotation, NewLabel, Project, StoredFrame, WriteContext, open_project
from annotator.project.backup.take_in import copy_project
from annotator.project.changes import LabelChanged, Payload
from annotator.project.recordings import Recordings, SharedCloud, StoredRecording
from annotator.rcv.finish import FrameProposals
from annotator.recordings import ReaderOptions, open_recording, stored_options
from annotator.recordings.look_around import RigCamera
from annotator.types import (
    Box2D,
    BoxKind,
    Correction,
    DetectorKind,
    OrientedBox,
    Proposal,
    Quality,
    ReviewState,
    Source,
)
from annotator.types.errors import ConfigError, FormatError, MovedError, StaleRevisionError, TrackTakenError
from annotator.workflows.add_recordings import add_recordings, move_recording
from annotator.workflows.evaluate import Protocol, evaluate_project
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.frame_source import FrameSource, seen_labels
from annotator.workflows.importing import BoxFormat, Note, import_labels, import_proposals, read_labels
from annotator.workflows.inspect import inspect_recording
from annotator.workflows.proposing.annotate import AnnotateSummary, Batch
from annotator.workflows.proposing.tasks import FrameAnswer
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.copy_next import copy_next
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.tracks.operations import apply
from annotator.workflows.tracks.propose_boxes import boxes_of
from annotator.workflows.tracks.still_objects import StandStill, find_sightings
from annotator.workflows.training.samples import gather, image_samples
from annotator.workflows.workbench.save_object import apply_changes

MakeProject = Callable[..., Project]
# 45 degrees to the left of ahead: two of four virtual cameras see it.
BETWEEN = np.array([10.0, 10.0, 0.0])
AROUND = ReaderOptions(look_around=4)


def write_clouds(folder: Path, frames: int = 2) -> Path:
    """Clouds of a LiDAR (x ahead, y left, z up) with a dense car between two cameras."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    for number in range(frames):
        ground = np.column_stack([rng.uniform(-30, 30, (4000, 2)), np.full(4000, -1.7)])
        car = BETWEEN + rng.uniform([-2, -1, -0.7], [2, 1, 0.7], (1500, 3))
        np.save(folder / f"{number}.npy", np.vstack([ground, car]).astype(np.float32))
    return folder


def car_in(project: Project, frame: StoredFrame, shift_m: float = 0.0) -> OrientedBox:
    """The car's box, along x, in a frame's camera."""
    camera = FrameSource(project).recording(frame.recording_id)
    assert isinstance(camera, RigCamera)
    box = OrientedBox.from_parts(BETWEEN + np.array([shift_m, 0, 0]), np.eye(3), np.array([4.0, 2.0, 1.4]))
    assert frame.index is not None
    return box.transformed(camera.T_rig_camera(frame.index).inv())


@pytest.fixture
def around(make_project: MakeProject, tmp_path: Path) -> Project:
    """A project of class car with four virtual cameras and two moments."""
    project = make_project(classes=("car",))
    add_recordings(project, [write_clouds(tmp_path / "clouds")], options=AROUND, cameras=("all",))
    return project


def frames_of(project: Project, number: int = 0) -> dict[str, StoredFrame]:
    return {one.name.partition("@")[2]: project.frames.find(one.id, str(number)) for one in project.recordings.all()}


def cameras_of(project: Project, frame: StoredFrame) -> list[tuple[str, str]]:
    """The recordings of the frames of a moment, with their keys."""
    names = {one.id: one.name for one in project.recordings.all()}
    return [(names[each.recording_id], each.key) for each in project.frames.of() if each.moment_id == frame.moment_id]


def accept(project: Project, frame: StoredFrame, box: OrientedBox) -> str:
    context = WriteContext(project.frames.get(frame.id).revision, "maria", Source.MANUAL)
    return project.labels.create(frame.id, [NewLabel("car", box)], context).uids[0]


def test_a_still_object_is_seen_by_the_cameras_of_a_rig(make_project: MakeProject, tmp_path: Path):
    """Each moment has one label of it, of a camera that sees it; the LiDAR moves on by two metres."""
    folder, project = write_clouds(tmp_path / "clouds"), make_project(classes=("car",))
    for number in range(2):  # the car stands in the world
        xyz_m = np.load(folder / f"{number}.npy")
        np.save(folder / f"{number}.npy", xyz_m - np.float32([2.0 * number, 0.0, 0.0]))
    rows = [f"{number},{2 * number},0,0,0,0,0,1" for number in range(2)]
    (folder / "poses.csv").write_text("\n".join(["key,x,y,z,qx,qy,qz,qw", *rows]))
    add_recordings(project, [folder], options=AROUND, cameras=("all",))
    first, second = frames_of(project)["around-000"], frames_of(project, 1)
    box = car_in(project, first)
    new = NewLabel("car", box, track_id=1)
    project.labels.create(first.id, [new], WriteContext(0, "maria"))
    apply(project, first.recording_id, 1, StandStill(), "maria")
    assert find_sightings(project, first.recording_id) == 1
    for frame in second.values():
        (seen,) = project.labels.of_moment(frame.id)
        assert project.frames.get(seen.made_in) == second["around-000"]
        assert iou_3d(seen.label.box, car_in(project, frame, -2.0)) == pytest.approx(1.0, abs=1e-6)
    assert project.labels.count() == 2


def test_all_cameras_are_added_as_recordings_of_one_rig(around: Project, tmp_path: Path):
    stored = around.recordings.all()
    assert [one.name for one in stored] == [f"clouds@around-{angle:03}" for angle in (0, 90, 180, 270)]
    assert json.loads(stored[1].options) == {"look_around": 4, "camera": "around-090"}
    again = add_recordings(around, [tmp_path / "clouds"], options=AROUND, cameras=("around-180", "around-000"))
    assert [one.is_new for one in again] == [False, False]
    # another number of cameras, and the clouds alone, are no part of it
    add_recordings(around, [tmp_path / "clouds"], options=ReaderOptions(look_around=6, camera="around-060"))
    add_recordings(around, [tmp_path / "clouds"])
    here = around.frames.find(stored[1].id, "1")
    assert cameras_of(around, here) == [(f"clouds@around-{angle:03}", "1") for angle in (0, 90, 180, 270)]


def test_nobody_sees_a_part_of_a_rig(make_project: MakeProject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    project, add, seen = make_project(), Recordings.add, list[int]()

    def looking(*arguments: Any) -> StoredRecording:
        seen.append(len(ThreadPoolExecutor(1).submit(project.recordings.all).result()))
        return add(*arguments)

    monkeypatch.setattr(Recordings, "add", looking)
    add_recordings(project, [write_clouds(tmp_path / "clouds")], options=AROUND, cameras=("all",))
    assert seen == [0, 0, 0, 0] and len(project.recordings.all()) == 4


def test_a_frame_whose_pose_was_missing_joins_its_moment_once_it_is_known(make_project: MakeProject, tmp_path: Path):
    project = make_project()
    both = {key: SharedCloud(key, RigidTransform.identity()) for key in ("0", "1")}
    add = partial(project.recordings.add, tmp_path, "nuscenes", keys=["0", "1"], is_sequence=True)
    one = add(name="one", options='{"camera":"a"}', clouds=both)
    two = add(name="two", options='{"camera":"b"}', clouds={"0": both["0"]})
    moments = [frame.moment_id for frame in project.frames.of([one.id])]
    assert [frame.moment_id for frame in project.frames.of([two.id])] == [moments[0], 4]
    project.frames.finalise(moments[1], WriteContext(0, "maria"))
    project.recordings.rescan(two.id, ["0", "1"], clouds=both)
    joined = project.frames.of([two.id])
    assert [(frame.moment_id, frame.revision, frame.finalised) for frame in joined] == [
        (moments[0], 0, False),
        (moments[1], 1, False),
    ]
    # a camera with two frames of a cloud has one of them in the moment
    three = add(name="three", options='{"camera":"c"}', clouds={"0": both["0"], "1": both["0"]})
    assert [frame.moment_id for frame in project.frames.of([three.id])] == [moments[0], 6]


def test_scenes_and_cameras_of_a_dataset(make_project: MakeProject, tmp_path: Path):
    project = make_project()
    small(tmp_path / "set")
    one = add_recordings(project, [tmp_path / "set"])
    assert [each.recording.name for each in one] == ["scene-0000@CAM_FRONT"]
    assert [note.partition(":")[0] for note in one[0].notes] == ["2 scenes", "2 cameras"]
    both = add_recordings(make_project(), [tmp_path / "set"], cameras=("all",))
    assert [[note.partition(":")[0] for note in each.notes] for each in both] == [["2 scenes"], ["2 scenes"]]
    every = add_recordings(project, [tmp_path / "set"], scenes=("all",), cameras=("CAM_BACK", "CAM_FRONT"))
    assert [each.recording.name for each in every] == [
        f"scene-000{scene}@{camera}" for scene in (0, 1) for camera in ("CAM_BACK", "CAM_FRONT")
    ]
    assert [each.is_new for each in every] == [True, False, True, True]
    for stored in project.recordings.all():
        frame = project.frames.of([stored.id])[4]
        scene = stored.name.partition("@")[0]
        assert {name for name, _ in cameras_of(project, frame)} == {f"{scene}@CAM_BACK", f"{scene}@CAM_FRONT"}
        both = [FrameSource(project).read(each) for each in project.frames.of() if each.moment_id == frame.moment_id]
        assert both[0].timestamp_ns != both[1].timestamp_ns and [each.index for each in both] == [4, 4]
    with pytest.raises(ConfigError, match="has no camera left, right; it has CAM_BACK, CAM_FRONT"):
        add_recordings(project, [tmp_path / "set"], cameras=("CAM_FRONT", "left", "right"))


def test_a_label_belongs_to_the_moment_and_every_camera_sees_it_at_the_same_place(around: Project):
    frames = frames_of(around)
    uid = accept(around, frames["around-090"], car_in(around, frames["around-090"]))
    for camera, frame in frames.items():
        (label,) = around.labels.of_moment(frame.id)
        assert (label.label.uid, label.frame_id, label.made_in) == (uid, frame.id, frames["around-090"].id)
        np.testing.assert_allclose(box_corners(label.label.box), box_corners(car_in(around, frame)), atol=1e-9)
        shown = seen_labels(around, FrameSource(around), frame)
        assert len(shown) == (camera in ("around-000", "around-090"))
    assert around.labels.of_frame(frames_of(around, 1)["around-000"].id) == ()
    # it is changed from any of them, at the revision that all have
    assert {around.frames.get(frame.id).revision for frame in frames.values()} == {1}
    moved = car_in(around, frames["around-000"], 1.0)
    context = WriteContext(1, "maria", Source.MANUAL)
    around.labels.edit(frames["around-000"].id, uid, context, label="car", box=moved, track_id=3)
    (label,) = around.labels.select()
    np.testing.assert_allclose(
        box_corners(label.label.box), box_corners(car_in(around, frames["around-090"], 1.0)), atol=1e-9
    )
    with pytest.raises(StaleRevisionError):
        around.labels.accept(frames["around-180"].id, uid, context)
    with pytest.raises(TrackTakenError, match="track 3 has a box"):
        box = car_in(around, frames["around-180"], -30.0)
        context = WriteContext(2, "maria", Source.MANUAL)
        around.labels.create(frames["around-180"].id, [NewLabel("car", box, track_id=3)], context)
    # tracks are those of the rig
    assert {around.labels.next_track_id(frame.recording_id) for frame in frames.values()} == {4}
    (seen,) = around.labels.along(frames["around-270"].recording_id, tracks=[3])
    assert seen.frame_id == frames["around-270"].id
    around.history.undo("maria")
    around.history.undo("maria")
    assert around.labels.of_frame(frames["around-270"].id) == ()
    around.log.rebuild()
    assert {around.frames.get(frame.id).revision for frame in frames.values()} == {4}


def test_a_label_that_another_camera_rejects_loses_the_box_on_the_image_that_it_was_drawn_on(around: Project):
    here, there = (frames_of(around)[name] for name in ("around-000", "around-090"))
    on_image = Box2D("car", 10.0, 10.0, 40.0, 40.0)
    around.boxes.set_on_image(there.id, [on_image], BoxKind.BOX, WriteContext(0, "maria"))
    new = NewLabel("car", car_in(around, there), image_box=on_image)
    (uid,) = around.labels.create(there.id, [new], WriteContext(1, "maria")).uids

    def change(payload: Payload, revision: int) -> None:
        apply_changes(around, here.id, [payload], WriteContext(revision, "eve"), pytest.fail)

    def drawn() -> tuple[Box2D, ...]:
        stored = around.boxes.on_image(there.id)
        return () if stored is None else stored.boxes

    change(LabelChanged(uid=uid, state=ReviewState.REJECTED), 2)
    assert around.frames.get(here.id).revision == 4 and drawn() == ()
    around.history.undo("eve")
    assert drawn() == (on_image,) and around.labels.of_frame(here.id)[0].state is ReviewState.ACCEPTED


def test_an_object_that_is_seen_by_one_camera_after_the_other_has_one_track(around: Project):
    for number, camera in enumerate(("around-000", "around-090")):
        frame = frames_of(around, number)[camera]
        accept(around, frame, car_in(around, frame))
    counts = link_tracks(around)
    assert (counts.recordings, counts.boxes, counts.tracks, counts.changed) == (4, 2, 1, 2)
    assert [stored.label.track_id for stored in around.labels.select()] == [1, 1]
    assert link_tracks(around).changed == 0
    recording = frames_of(around)["around-270"].recording_id
    assert [(frame.key, label.track_id) for frame, label in boxes_of(around, recording, 1)] == [("0", 1), ("1", 1)]


def test_a_proposal_in_the_finalised_frame_of_another_camera_is_not_replaced(around: Project):
    here, there = frames_of(around)["around-000"], frames_of(around, 1)["around-090"]
    uid = accept(around, here, car_in(around, here))
    around.log.append(here.id, [LabelChanged(uid=uid, track_id=1)], WriteContext(1, "maria"))
    is_open = NewLabel("car", car_in(around, there), track_id=1, state=ReviewState.PROPOSED)
    around.labels.create(there.id, [is_open], WriteContext(0, "maria"))
    around.frames.finalise(there.id, WriteContext(1, "maria"))
    with pytest.raises(ConfigError, match="a proposal is here, in the finalised frame of another camera"):
        copy_next(around, here.id, uid, 2, "maria")


def test_a_camera_that_is_added_later_sees_the_labels_and_a_correction_moves_them_in_it_alone(
    make_project: MakeProject, tmp_path: Path
):
    project, path = make_project(classes=("car",)), write_clouds(tmp_path / "clouds")
    add_recordings(project, [path], options=AROUND, cameras=("around-090",))
    accept(project, frames_of(project)["around-090"], car_in(project, frames_of(project)["around-090"]))
    add_recordings(project, [path], options=AROUND, cameras=("around-000",))
    late, first = frames_of(project)["around-000"], frames_of(project)["around-090"]
    assert late.revision == first.revision == 1
    correction = Correction((0.0, 0.1, 0.0), (0.0, 0.0, 0.5))
    project.adjustments.correct(late.recording_id, correction, "maria")
    for frame, T in ((late, correction.T_camera_recorded), (first, RigidTransform.identity())):
        (label,) = project.labels.of_frame(frame.id)
        expected = car_in(project, frame).transformed(T)
        np.testing.assert_allclose(box_corners(label.box), box_corners(expected), atol=1e-9)
    # labels go with the camera in which they were made, and keep their places; a copy has the other camera alone
    uid, context = label.uid, WriteContext(project.frames.get(first.id).revision, "maria")
    project.log.append(first.id, [LabelChanged(uid=uid, track_id=3)], context)
    project.recordings.remove(first.recording_id, "maria")
    assert project.labels.of_frame(late.id) == ()
    box = car_in(project, late).transformed(correction.T_camera_recorded)
    proposal = Proposal("car", 0.5, box, Box2D("car", 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0))
    by_machine = WriteContext(project.frames.get(late.id).revision, "rcv", Source.AUTO)
    project.proposals.replace(late.id, [proposal], by_machine, track_ids=[3])
    assert [label.track_id for label in project.labels.of_frame(late.id)] == [None]
    brought = project.proposals.bring("theirs", {late.id: [NewLabel("car", box, 0.9, track_id=3)]})
    assert brought[late.id].is_open == (True,)
    (proposed,) = project.labels.of_frame(late.id)
    context = WriteContext(project.frames.get(late.id).revision, "maria")
    with pytest.raises(TrackTakenError, match="track 3 has a box"):
        project.log.append(late.id, [LabelChanged(uid=proposed.uid, track_id=3)], context)
    copy = open_project(copy_project(project.path, tmp_path, "copy", labels=False))
    assert all(frame.moment_id == frame.id >= late.id for frame in copy.frames.of())


def test_an_object_proposed_from_two_cameras_is_one_label(around: Project):
    frames = frames_of(around)
    run = around.jobs.start(image_detector="i", view_detector="v", config_json="{}")
    batch = Batch(around, run, AnnotateSummary(), BoxKind.BOX)

    def propose(camera: str, shift_m: float, score: float) -> None:
        box = car_in(around, frames[camera], shift_m)
        proposal = Proposal("car", score, box, Box2D("car", 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0))
        batch.store(frames[camera], FrameAnswer(FrameProposals("0", (proposal,), ()), None, 0.1))

    for _ in range(2):
        propose("around-000", 0.0, 0.5)
        propose("around-090", 0.4, 0.9)
        assert batch.summary.failures == 0
        (found,) = around.labels.of_moment(frames["around-090"].id)
        assert found.made_in == frames["around-000"].id
    # another object is one of its own
    propose("around-090", 3.5, 0.9)
    assert len(around.labels.of_frame(frames["around-090"].id)) == 2


def test_an_object_is_exported_once_with_the_camera_in_which_it_was_made(around: Project, tmp_path: Path):
    frames = frames_of(around)
    run = around.jobs.start(image_detector="i", view_detector="v", config_json="{}")
    batch = Batch(around, run, AnnotateSummary(), BoxKind.BOX)
    proposal = Proposal(
        "car", 0.5, car_in(around, frames["around-000"]), Box2D("car", 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0)
    )
    batch.store(frames["around-000"], FrameAnswer(FrameProposals("0", (proposal,), ()), None, 0.1))
    later = frames_of(around, 1)
    accept(around, later["around-090"], car_in(around, later["around-090"]))
    choose = ExportFilter(states=(ReviewState.PROPOSED, ReviewState.ACCEPTED))
    export_project(around, tmp_path / "out", ExportFormat.OPENLABEL, choose=choose)
    assert exported(tmp_path / "out") == {("clouds_around_000", "0"): 1, ("clouds_around_090", "1"): 1}


def exported(folder: Path) -> dict[tuple[str, str], int]:
    """The number of objects of each frame, by file and key."""
    counts = {}
    for file in folder.rglob("*.json"):
        for key, frame in json.loads(file.read_text())["openlabel"]["frames"].items():
            counts[file.stem, key] = len(frame["objects"])
    return counts


def test_an_object_of_another_camera_is_an_object_for_the_image_detector(around: Project):
    frames = frames_of(around)
    accept(around, frames["around-000"], car_in(around, frames["around-000"]))
    accept(around, frames["around-090"], car_in(around, frames["around-090"], 2.5))
    samples = list(image_samples(around, gather(around, [DetectorKind.IMAGE]), lambda *_: None))
    assert [len(sample.boxes) for sample in samples] == [2, 2]


def test_an_object_is_a_2d_box_on_each_image_that_shows_it(around: Project, tmp_path: Path):
    frames = frames_of(around)
    accept(around, frames["around-000"], car_in(around, frames["around-000"]))
    accept(around, frames["around-090"], car_in(around, frames["around-090"], 2.5))
    accept(around, frames["around-180"], car_in(around, frames["around-180"], -30.0))
    export_project(around, tmp_path / "out", ExportFormat.COCO)
    (content,) = (json.loads(file.read_text()) for file in (tmp_path / "out").rglob("*.json"))
    names = {image["id"]: image["file_name"] for image in content["images"]}
    counts = Counter(names[box["image_id"]].rpartition("/")[2][:17] for box in content["annotations"])
    assert counts == {"clouds_around_000": 2, "clouds_around_090": 2, "clouds_around_180": 1}


def test_labels_of_all_cameras_are_measured_against_the_true_boxes_of_each(make_project: MakeProject, tmp_path: Path):
    project = make_project(classes=("vehicle.car",))
    small(tmp_path / "set", scenes=1)
    added = [
        one.recording.id
        for one in add_recordings(project, [tmp_path / "set"], options=ReaderOptions(look_around=4), cameras=("all",))
    ]
    imported = sum(import_own_labels(project, one).boxes.total() for one in added)
    # two objects at two moments, though several cameras see each
    assert imported == 4
    for frame in project.frames.of():
        project.frames.finalise(frame.id, WriteContext(project.frames.get(frame.id).revision, "maria", Source.MANUAL))
    report = evaluate_project(project, Protocol.ORIENTED)
    row = dict(zip(report.columns, report.rows[0], strict=True))
    seen = [
        len(load_truth(recording, index, recording.frame(index)))
        for one in project.recordings.all()
        for recording in [FrameSource(project).recording(one.id)]
        for index in range(len(recording))
    ]
    assert sum(seen) > 4
    assert (row["objects"], row["detections"]) == (sum(seen), sum(seen))


@pytest.mark.shared
def test_the_real_boxes_are_imported_once(make_project: MakeProject, shared: Path, tmp_path: Path):
    real(shared / "data" / "nuscenes_frame", tmp_path / "set")
    names = ("car", "truck", "trailer", "bus", "construction_vehicle", "bicycle", "motorcycle", "pedestrian")
    names = (*names, "traffic_cone", "barrier", "other")
    project = make_project(classes=names)
    added = [one.recording.id for one in add_recordings(project, [tmp_path / "set"], cameras=("all",))]
    counts = [import_own_labels(project, recording) for recording in added]
    # each camera's own boxes, and all of them in global coordinates
    seen = {
        tuple(np.round(truth.box.transformed(T).center_m, 3)): truth
        for recording in (open_recording(tmp_path / "set", ReaderOptions(camera=name)) for name in cameras(project))
        for frame in [recording.frame(0)]
        for T in [frame.T_camera_label.inv() if frame.T_camera_label is not None else None]
        for truth in load_truth(recording, 0, frame)
    }
    assert sum(one.boxes.total() for one in counts) == len(seen) >= 65
    assert sum(one[Note.OTHER_CAMERA] for one in counts) >= 10
    assert {len(project.labels.of_frame(frame.id)) for frame in project.frames.of()} == {len(seen)}
    # a second import adds nothing
    assert sum(import_own_labels(project, recording).boxes.total() for recording in added) == 0


def cameras(project: Project) -> list[str]:
    return [one.name.partition("@")[2] for one in project.recordings.all()]


UTM_M = np.array([701_378.25, 4_485_513.5, 640.75])
XYZ = np.random.default_rng(3).uniform((-10, -10, -1.6), (10, 10, 0), (1000, 3))
# One box that stands still in the map, seen from two places.
BOX = OrientedBox.at(
    RigidTransform.from_components(np.add(UTM_M, (3.125, -1.5, 0.8)), Rotation.from_euler("z", 0.5)),
    np.array([4, 2, 1.6]),
)
HELD = (ExportFormat.RCV, ExportFormat.OPENLABEL, ExportFormat.NUSCENES, ExportFormat.SUSTECHPOINTS)


def scans(folder: Path, *shifts: float, first: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    for number, shift in enumerate(shifts, first):
        cloud = XYZ + UTM_M + [shift, 0, 0]
        cloud[0] = 0
        np.save(folder / f"{number:06}.npy", cloud)
    return folder


def labelled(project: Project, folder: Path, options: ReaderOptions = ReaderOptions()) -> Project:  # noqa: B008
    add_recordings(project, [folder], options=options)
    source = FrameSource(project)
    for stored in project.frames.of():
        T_world_camera = source.read(stored).T_world_camera
        assert T_world_camera is not None
        box = NewLabel("car", BOX.transformed(T_world_camera.inv()), track_id=1)
        project.labels.create(stored.id, [box], WriteContext(0, "me", Source.MANUAL))
    return project


def in_map(project: Project) -> list[OrientedBox]:
    """All boxes of a project in map coordinates."""
    source = FrameSource(project)
    return [
        each.box.transformed(source.read(stored).T_world_camera)  # type: ignore[arg-type]
        for stored in project.frames.of()
        for each in project.labels.of_frame(stored.id)
    ]


def assert_stands_still(boxes: list[OrientedBox], count: int, atol: float = 1e-6) -> None:
    assert len(boxes) == count
    for box in boxes:
        np.testing.assert_allclose(box.center_m, BOX.center_m, rtol=0, atol=atol)
        np.testing.assert_allclose(box.size_m, BOX.size_m, atol=atol)
        np.testing.assert_allclose(box.rotation, BOX.rotation, atol=atol)


@pytest.fixture
def cars(make_project: Callable[..., Project]) -> Callable[[], Project]:
    return lambda: make_project(classes=("car",), rotation=BoxRotation.FREE)


def test_the_origin_is_stored_so_that_frames_stay_when_the_first_file_is_gone(
    cars: Callable[[], Project], tmp_path: Path
):
    project, folder = cars(), scans(tmp_path / "drive", 0, 4, 9)
    (added,) = add_recordings(project, [folder])
    report = inspect_recording(folder)
    origin = report.origin
    assert origin == tuple(np.floor(np.median(XYZ[1:] + UTM_M, axis=0)))
    assert report.frame is not None
    assert (report.frame.place, report.frame.points) == (pytest.approx(origin), 999)
    assert stored_options(added.recording.options).origin == origin
    before = FrameSource(project).read(project.frames.of()[2])
    (folder / "000000.npy").unlink()
    assert inspect_recording(folder).origin != origin
    after = FrameSource(project).read(project.frames.of()[2])
    np.testing.assert_array_equal(after.cloud.xyz_m, before.cloud.xyz_m)
    # added again, it is the same recording, and new frames come with it
    scans(folder, 12, first=3)
    (again,) = add_recordings(project, [folder])
    assert (again.is_new, again.new_frames, again.missing_frames) == (False, 1, 1)
    assert again.recording.options == added.recording.options
    assert len(project.recordings.all()) == 1


def test_a_moved_recording_in_map_coordinates_is_recognised(cars: Callable[[], Project], tmp_path: Path):
    project, folder = cars(), scans(tmp_path / "drive", 0, 4)
    (added,) = add_recordings(project, [folder])
    new = folder.rename(tmp_path / "elsewhere")
    # its first cloud would give another origin now
    np.save(new / "+first.npy", XYZ + UTM_M + [50, 0, 0])
    with pytest.raises(MovedError, match="is the recording drive"):
        add_recordings(project, [new])
    assert move_recording(project, added.recording.id, new).options == added.recording.options


def test_a_recording_with_a_camera_is_not_one_that_has_moved_and_had_none(cars: Callable[[], Project], tmp_path: Path):
    project, folder = cars(), scans(tmp_path / "drive", 0, 4)
    add_recordings(project, [folder])
    folder.rename(tmp_path / "gone")
    other = scans(tmp_path / "other", 0, 4)
    (other / "calib.txt").write_text(OBJECT_CALIB)
    (added,) = add_recordings(project, [other])
    assert (added.is_new, added.recording.options) == (True, "")
    assert len(project.recordings.all()) == 2


@pytest.mark.parametrize("format", HELD)
def test_a_box_that_stands_still_does_so_after_export_and_import(
    cars: Callable[[], Project], tmp_path: Path, format: ExportFormat
):
    """Also into a project that has the recording with another origin, and if the vehicle drove on for kilometres."""
    folder = scans(tmp_path / "drive", 0, 7_000.0)
    project = labelled(cars(), folder)
    assert_stands_still(in_map(project), 2)
    report = export_project(project, tmp_path / "out", format)
    assert "origin" not in {loss.kind for loss in report.losses}
    other = cars()
    elsewhere = tuple(np.add(inspect_recording(folder).origin, [-37.5, 12.25, 3.0]).tolist())
    add_recordings(other, [folder], options=ReaderOptions(origin=elsewhere))
    boxes = read_labels(BoxFormat(format), tmp_path / "out")
    assert import_labels(other, boxes).boxes == {"car": 2}
    assert_stands_still(in_map(other), 2)
    third = cars()
    add_recordings(third, [folder], options=ReaderOptions(origin=elsewhere))
    import_proposals(third, boxes, "mine")
    assert_stands_still(in_map(third), 2)


@pytest.mark.parametrize("format", [ExportFormat.RCV, ExportFormat.OPENLABEL, ExportFormat.NUSCENES])
def test_an_export_that_is_opened_again_is_in_the_same_map(
    cars: Callable[[], Project], tmp_path: Path, format: ExportFormat
):
    project = labelled(cars(), scans(tmp_path / "drive", 0, 4))
    export_project(project, tmp_path / "out", format)
    opened = open_recording(tmp_path / "out")
    for number, shift in enumerate((0, 4)):
        frame = opened.frame(number)
        assert frame.T_world_camera is not None
        seen = frame.T_world_camera.apply(frame.cloud.xyz_m.astype(float))
        cloud = (XYZ + UTM_M + [shift, 0, 0])[1:]
        distance = np.linalg.norm(seen[:, None] - cloud[None], axis=2).min(axis=1)
        assert (len(seen) > 100, bool(distance.max() < 2e-4)) == (True, True)
    again = cars()
    (added,) = add_recordings(again, [tmp_path / "out"])
    import_own_labels(again, added.recording.id)
    assert_stands_still(in_map(again), 2)


def labelcloud_json(folder: Path) -> None:
    folder.mkdir()
    yaw = 0.5
    x, y, z = BOX.center_m.tolist()
    box = {"name": "car", "centroid": {"x": x, "y": y, "z": z}, "rotations": {"x": 0, "y": 0, "z": yaw},
           "dimensions": {"length": 4, "width": 2, "height": 1.6}}  # fmt: skip
    for number in range(2):
        (folder / f"{number:06}.json").write_text(json.dumps({"objects": [box]}))
    (folder / "_classes.json").write_text(json.dumps({"classes": [], "format": "centroid_rel"}))


def test_labels_in_map_coordinates_land_where_they_are(cars: Callable[[], Project], tmp_path: Path):
    project = cars()
    add_recordings(project, [scans(tmp_path / "drive", 0, 4)])
    labelcloud_json(tmp_path / "labels")
    assert import_labels(project, read_labels(BoxFormat.LABELCLOUD, tmp_path / "labels")).boxes == {"car": 2}
    assert_stands_still(in_map(project), 2)


def test_map_coordinates_in_a_format_of_boxes_relative_to_the_camera_are_refused(
    cars: Callable[[], Project], tmp_path: Path
):
    project = cars()
    add_recordings(project, [scans(tmp_path / "drive", 0)])
    box = {"label": "car", "center": BOX.center_m.tolist(), "size": [4, 2, 1.6], "rotation": BOX.rotation.tolist()}
    (tmp_path / "boxes.json").write_text(json.dumps({"000000": box}))
    boxes = read_labels(BoxFormat.BOXES, tmp_path / "boxes.json")
    for run in (import_labels, import_proposals):
        with pytest.raises(
            FormatError, match="000000: a box of car is 4,540 km from the camera: its coordinates are a"
        ):
            run(project, boxes)
    assert not project.labels.select()
