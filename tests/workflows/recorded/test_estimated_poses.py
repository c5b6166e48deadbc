"""Estimated poses: near the truth, or said to be uncertain; kept, undone and replaced as one action."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from annotator.geometry.iou import iou_3d
from annotator.geometry.odometry import LEAST_GRIP, LEAST_OVERLAP, Odometry
from annotator.project import NewLabel, WriteContext, create_project, open_project
from annotator.project.backup.repair import repair
from annotator.project.backup.verify import verify
from annotator.recordings import Recording, open_recording
from annotator.synthetic import write_generated
from annotator.types import Frame, PointCloud, ReviewState
from annotator.types.errors import ConfigError, HistoryError, ProjectError
from annotator.workflows.add_recordings import add_recordings, register_recording
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.recorded.poses import estimate_poses, poses_of
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.tracks.operations import apply
from annotator.workflows.tracks.still_objects import Move, StandStill, find_sightings

ANN, BOB, FRAMES, STILL = "ann", "bob", 8, 3
Made = Callable[[str, Callable[[Path], object]], Path]


@pytest.fixture(scope="module")
def recording(made_once: Made) -> Recording:
    """A tour of a room with exact poses."""
    made = made_once("tour to estimate", lambda path: write_generated(path / "tour", "tour", FRAMES, 0, 320, 240))
    return open_recording(made / "tour")


@pytest.fixture
def unposed(recording: Recording, tmp_path: Path) -> Path:
    """The tour without its poses; its fifth frame sees nothing."""
    path = tmp_path / "tour"
    shutil.copytree(recording.path, path, ignore=shutil.ignore_patterns("poses.csv"))
    (path / "depth" / "000004.png").unlink()
    shutil.copyfile(path / "color" / "000004.jpg", path / "color" / "000005.jpg")
    return path


def off(recording: Recording, found: dict[int, RigidTransform]) -> float:
    """The error at the end of the way, share of the way."""
    true = {i: recording.pose(i) for i in found}
    steps = [true[i].inv() * true[j] for i, j in pairwise(found)]  # type: ignore[union-attr,operator]
    first, last = min(found), max(found)
    error = (true[first].inv() * true[last]).inv() * (found[first].inv() * found[last])  # type: ignore[union-attr,operator]
    return float(np.linalg.norm(error.translation) / sum(np.linalg.norm(step.translation) for step in steps))


def placed(frames: list[Frame]) -> dict[int, RigidTransform]:
    odometry = Odometry(frames[0])
    found = [odometry.add(frame).T_first_camera for frame in frames]
    return {i: T for i, T in enumerate(found) if T is not None}


def as_scan(frame: Frame) -> Frame:
    """What a sensor without images sees of it."""
    return replace(frame, depth_m=None, cloud=PointCloud(frame.cloud.xyz_m))


def test_the_way_of_a_depth_camera_is_nearly_that_of_the_truth(recording: Recording) -> None:
    found = placed([recording.frame(i) for i in range(FRAMES)])
    assert len(found) == FRAMES
    assert off(recording, found) < 0.02


def test_the_way_of_a_lidar_is_nearly_that_of_the_truth(made_once: Made) -> None:
    made = made_once("drive to estimate", lambda path: write_generated(path / "drive", "drive", 5, 1))
    drive = open_recording(made / "drive")
    found = placed([drive.frame(i) for i in range(5)])
    assert len(found) == 5
    assert off(drive, found) < 0.01


@pytest.mark.parametrize("seen", [lambda frame: frame, as_scan], ids=["depth images", "scans"])
def test_a_frame_that_may_slide_or_sees_another_place_is_left_out(
    recording: Recording, seen: Callable[[Frame], Frame]
) -> None:
    first = recording.frame(0)
    v, u = np.mgrid[0:240, 0:320]
    xyz_m = np.stack([(u - 160) / 262.5 * 2.0, (v - 120) / 262.5 * 2.0, np.full(u.shape, 2.0)], axis=-1)
    index = np.arange(u.size, dtype=np.int32)
    cloud = PointCloud(xyz_m.reshape(-1, 3).astype(np.float32), pixel_index=index)
    depth_m, rgb = np.full(u.shape, 2.0, np.float32), np.full((*u.shape, 3), 128, np.uint8)
    wall = seen(replace(first, rgb=rgb, depth_m=depth_m, cloud=cloud))
    odometry = Odometry(wall)
    odometry.add(wall)
    along = odometry.add(wall)
    assert along.T_first_camera is None and along.grip < LEAST_GRIP
    odometry = Odometry(seen(first))
    odometry.add(seen(first))
    elsewhere = odometry.add(wall)
    assert elsewhere.T_first_camera is None
    again = odometry.add(seen(recording.frame(1)))
    assert again.T_first_camera is not None, "the frames after it go on from those before"


def test_objects_stand_still_by_estimated_poses_which_are_one_action(
    recording: Recording, unposed: Path, tmp_path: Path
) -> None:
    project = create_project(tmp_path, "p", ("object", "person"))
    add_recordings(project, [unposed], leave_out_broken=True)
    assert poses_of(project, 1).source == "none"
    estimate_poses(project, 1, BOB)
    said = poses_of(project, 1)
    assert said.source == "estimate" and said.certainty is not None and said.poses is not None
    assert said.certainty.overlap[1] >= LEAST_OVERLAP
    source = FrameSource(project)
    frames = [each for each in project.frames.of() if each.index is not None]
    opened = [source.read(each) for each in frames]
    found = {int(f.key): f.T_world_camera for f in opened if f.T_world_camera is not None}
    assert said.poses.posed == len(found) >= FRAMES - 2
    assert off(recording, found) < 0.02
    first, true = opened[0], load_truth(recording, 0, recording.frame(0))
    np.testing.assert_allclose(found[0].rotation.apply(first.up), [0, 0, 1], atol=1e-6)
    (box,) = [each.box for each in true if each.track_id == STILL]
    new = NewLabel("object", box, track_id=STILL, state=ReviewState.ACCEPTED)
    project.labels.create(frames[0].id, [new], WriteContext(project.frames.get(frames[0].id).revision, ANN))
    apply(project, 1, STILL, StandStill(), ANN)
    find_sightings(project, 1)
    labels = {each.frame_id: each.label.box for each in project.labels.along(1, tracks=[STILL])}
    for stored, i in zip(frames, map(int, (f.key for f in frames)), strict=True):
        (truth,) = [each.box for each in load_truth(recording, i, recording.frame(i)) if each.track_id == STILL]
        assert stored.key == "000005" or iou_3d(labels[stored.id], truth) > 0.9
    with pytest.raises(HistoryError, match="track of it stand still in this world: 3; first say that they move"):
        estimate_poses(project, 1, ANN, replace=True)
    # by another one: the operator's own last step is to make it still
    with pytest.raises(HistoryError, match="estimate the poses of tour: cannot be undone because 1 track of it stand"):
        project.history.undo(BOB)
    apply(project, 1, STILL, Move(), ANN)
    assert project.history.undo(BOB).words == "estimate the poses of tour"
    assert poses_of(project, 1).source == "none" and project.stills.poses(1) == {}
    assert FrameSource(project).read(frames[1]).T_world_camera is None
    with pytest.raises(ProjectError, match="the poses of tour are not estimated"):
        project.estimates.keep(1, (), ANN)


def test_recorded_poses_stay_unless_they_are_replaced_and_come_back(recording: Recording, tmp_path: Path) -> None:
    project = create_project(tmp_path, "p", ("object",))
    register_recording(project, recording)
    before = project.stills.poses(1)
    with pytest.raises(ConfigError, match="tour has poses already; --replace estimates them anew"):
        estimate_poses(project, 1, ANN)
    estimate_poses(project, 1, ANN, replace=True)
    estimated = project.stills.poses(1)
    assert len(estimated) == FRAMES
    assert not np.allclose(estimated[1].as_matrix(), before[1].as_matrix())
    register_recording(project, recording)  # a scan keeps them
    assert {i: T.as_matrix().tolist() for i, T in project.stills.poses(1).items()} == {
        i: T.as_matrix().tolist() for i, T in estimated.items()
    }
    project.close()
    assert verify(tmp_path / "p", deep=True).problems == ()
    repaired = repair(tmp_path / "p")
    with open_project(repaired.path) as other:
        assert poses_of(other, 1).source == "estimate"
        assert np.allclose(other.stills.poses(1)[2].as_matrix(), estimated[2].as_matrix())
    with open_project(tmp_path / "p") as project:
        assert project.history.next(ANN)[0] == "estimate the poses of tour"
        project.history.undo(ANN)
        assert poses_of(project, 1).source == "files"
        assert project.stills.poses(1)[1].as_matrix().tolist() == before[1].as_matrix().tolist()
        project.history.redo(ANN)
        assert project.stills.poses(1)[1].as_matrix().tolist() == estimated[1].as_matrix().tolist()
