"""Recordings in map coordinates: what a project keeps of them, and their boxes in exports and imports."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from kitti_samples import OBJECT_CALIB
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.project import BoxRotation, NewLabel, Project, WriteContext
from annotator.recordings import ReaderOptions, open_recording, stored_options
from annotator.types import OrientedBox, Source
from annotator.types.errors import FormatError, MovedError
from annotator.workflows.add_recordings import add_recordings, move_recording
from annotator.workflows.exporting import ExportFormat, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import BoxFormat, import_labels, import_proposals, read_labels
from annotator.workflows.inspect import inspect_recording
from annotator.workflows.recorded.own_labels import import_own_labels

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
