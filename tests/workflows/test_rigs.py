"""Rigs: several cameras of one moment share their labels, and an object is proposed, imported and exported once."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nuscenes_samples import real, small

from annotator.geometry.oriented_box import box_corners
from annotator.project import NewLabel, Project, StoredFrame, WriteContext
from annotator.rcv.finish import FrameProposals
from annotator.recordings import ReaderOptions, open_recording
from annotator.types import Box2D, BoxKind, DetectorKind, OrientedBox, Proposal, Quality, ReviewState, Source
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import add_recordings
from annotator.workflows.evaluate import Protocol, evaluate_project
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.frame_source import FrameSource, Rigs
from annotator.workflows.importing import Note
from annotator.workflows.proposing.annotate import AnnotateSummary, Batch
from annotator.workflows.proposing.tasks import FrameAnswer
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.training.samples import gather, image_samples

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
    camera = Rigs(project)._camera(frame.recording_id)
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


def accept(project: Project, frame: StoredFrame, box: OrientedBox) -> str:
    context = WriteContext(project.frames.get(frame.id).revision, "maria", Source.MANUAL)
    return project.labels.create(frame.id, [NewLabel("car", box)], context).uids[0]


def test_all_cameras_are_added_as_recordings_of_one_rig(around: Project, tmp_path: Path):
    stored = around.recordings.all()
    assert [one.name for one in stored] == [f"clouds@around-{angle:03}" for angle in (0, 90, 180, 270)]
    assert json.loads(stored[1].options) == {"look_around": 4, "camera": "around-090"}
    again = add_recordings(around, [tmp_path / "clouds"], options=AROUND, cameras=("around-180", "around-000"))
    assert [one.is_new for one in again] == [False, False]
    # another number of cameras, and the clouds alone, are no part of it
    add_recordings(around, [tmp_path / "clouds"], options=ReaderOptions(look_around=6, camera="around-060"))
    add_recordings(around, [tmp_path / "clouds"])
    rigs = Rigs(around)
    assert sorted(rigs.recordings()) == [one.id for one in stored]
    here = around.frames.find(stored[1].id, "1")
    assert [(each.recording, each.frame.key) for each in rigs.siblings(here)] == [
        (f"clouds@around-{angle:03}", "1") for angle in (0, 180, 270)
    ]
    for sibling in rigs.siblings(here):
        there, seen = FrameSource(around).read(sibling.frame), FrameSource(around).read(here)
        moved = sibling.T_here_there.apply(there.cloud.xyz_m.astype(np.float64))
        np.testing.assert_allclose(moved, seen.cloud.xyz_m, atol=1e-4)
        assert sibling.camera.width_px == there.camera.width_px


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
    rigs = Rigs(project)
    for stored in project.recordings.all():
        (sibling,) = rigs.siblings(project.frames.of([stored.id])[4])
        assert sibling.recording.partition("@")[0] == stored.name.partition("@")[0]
        here = FrameSource(project).read(project.frames.of([stored.id])[4])
        there = FrameSource(project).read(sibling.frame)
        assert here.timestamp_ns != there.timestamp_ns and sibling.frame.index == 4
        assert sibling.camera.width_px == there.camera.width_px
    with pytest.raises(ConfigError, match="has no camera left, right; it has CAM_BACK, CAM_FRONT"):
        add_recordings(project, [tmp_path / "set"], cameras=("CAM_FRONT", "left", "right"))


def test_labels_of_the_other_cameras_lie_at_the_same_place(around: Project):
    frames = frames_of(around)
    uid = accept(around, frames["around-090"], car_in(around, frames["around-090"]))
    rigs = Rigs(around)
    for camera in ("around-000", "around-180", "around-270"):
        (other,) = rigs.others(frames[camera])
        assert (other.label.uid, other.recording, other.frame.id) == (
            uid, "clouds@around-090", frames["around-090"].id,
        )  # fmt: skip
        np.testing.assert_allclose(box_corners(other.label.box), box_corners(car_in(around, frames[camera])), atol=1e-9)
    assert rigs.others(frames["around-090"]) == []
    assert Rigs(around).others(frames_of(around, 1)["around-000"]) == []


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
        found = {camera: around.labels.of_frame(frame.id) for camera, frame in frames.items()}
        assert {camera: len(labels) for camera, labels in found.items() if labels} == {"around-000": 1}
    # the log has the covered proposal, and what covers it
    latest = around.proposals.latest(frames["around-090"].id)
    assert latest is not None and latest.objects[0].covered_by == found["around-000"][0].uid
    # another object is one of its own
    propose("around-090", 3.5, 0.9)
    assert len(around.labels.of_frame(frames["around-090"].id)) == 1


def test_an_object_labelled_in_two_cameras_is_exported_once(around: Project, tmp_path: Path):
    frames = frames_of(around)
    run = around.jobs.start(image_detector="i", view_detector="v", config_json="{}")
    batch = Batch(around, run, AnnotateSummary(), BoxKind.BOX)
    proposal = Proposal(
        "car", 0.5, car_in(around, frames["around-000"]), Box2D("car", 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0)
    )
    batch.store(frames["around-000"], FrameAnswer(FrameProposals("0", (proposal,), ()), None, 0.1))
    reviewed = accept(around, frames["around-090"], car_in(around, frames["around-090"], 0.2))
    later = frames_of(around, 1)
    for camera in ("around-000", "around-090"):
        accept(around, later[camera], car_in(around, later[camera]))
    choose = ExportFilter(states=(ReviewState.PROPOSED, ReviewState.ACCEPTED))
    export_project(around, tmp_path / "out", ExportFormat.OPENLABEL, choose=choose)
    # the reviewed label of moment 0, and the camera that was added first of moment 1
    assert exported(tmp_path / "out") == {("clouds_around_090", "0"): 1, ("clouds_around_000", "1"): 1}
    # alone, the proposal is exported
    only = replace(choose, recordings=(frames["around-000"].recording_id,))
    export_project(around, tmp_path / "front", ExportFormat.OPENLABEL, choose=only)
    assert exported(tmp_path / "front") == {("clouds_around_000", "0"): 1, ("clouds_around_000", "1"): 1}
    assert reviewed not in {each.uid for each in around.labels.of_frame(frames["around-000"].id)}


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
    # labelled in both cameras, it is one object on each image
    accept(around, frames["around-090"], car_in(around, frames["around-090"]))
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
    imported = sum(import_own_labels(project, one, together=added).boxes.total() for one in added)
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
def test_the_real_boxes_are_imported_once_for_the_camera_that_sees_them_best(
    make_project: MakeProject, shared: Path, tmp_path: Path
):
    real(shared / "data" / "nuscenes_frame", tmp_path / "set")
    names = ("car", "truck", "trailer", "bus", "construction_vehicle", "bicycle", "motorcycle", "pedestrian")
    names = (*names, "traffic_cone", "barrier", "other")
    project = make_project(classes=names)
    added = [one.recording.id for one in add_recordings(project, [tmp_path / "set"], cameras=("all",))]
    counts = [import_own_labels(project, recording, together=added) for recording in added]
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
    for recording in added:
        (frame,) = project.frames.of([recording])
        siblings = Rigs(project).siblings(frame)
        assert not any(Rigs(project).is_better_seen(each.box, siblings) for each in project.labels.of_frame(frame.id))
        assert len(Rigs(project).others(frame)) + len(project.labels.of_frame(frame.id)) == len(seen)
    # a second import adds nothing
    assert sum(import_own_labels(project, recording, together=added).boxes.total() for recording in added) == 0


def cameras(project: Project) -> list[str]:
    return [one.name.partition("@")[2] for one in project.recordings.all()]
