"""Clouds in map coordinates: one origin a recording, precise points, and a virtual camera where they are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_writer import BagWriter, structured
from cloud_samples import camera_file, ros_cloud
from kitti_samples import OBJECT_CALIB

from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.virtual_camera import STEP_M
from annotator.recordings.ros import messages
from annotator.recordings.scan_file import Scans
from annotator.types import Frame
from annotator.types.errors import ConfigError, FrameError

UTM_M = np.array([701_378.25, 4_485_513.5, 640.75])
# The coordinates of a floor and a wall around (0, 0, 0); UTM coordinates need 64 bits.
XYZ = np.random.default_rng(3).uniform((-10, -10, -1.6), (10, 10, 0), (1001, 3))


def write_npy(path: Path, xyz: np.ndarray) -> None:
    np.save(path.with_suffix(".npy"), xyz)


def placed(frame: Frame) -> np.ndarray:
    """The points of a frame in the coordinates of its file."""
    assert frame.T_world_camera is not None
    assert frame.T_camera_label is not None
    there = frame.T_world_camera.apply(frame.cloud.xyz_m.astype(float))
    np.testing.assert_allclose(frame.T_camera_label.inv().apply(frame.cloud.xyz_m.astype(float)), there, atol=1e-8)
    return there


# How many of 1001 points are a driver's "no return", and how it writes them.
STRAYS: dict[str, tuple[int, float | tuple[float, ...]]] = {
    "none": (0, 0.0), "most": (900, 0.0), "one": (1, -0.0), "nan": (900, np.nan), "raised": (20, (0, 0, 1.73)),
    "number": (20, -9999.0),
}  # fmt: skip


@pytest.mark.parametrize("strays", STRAYS)
def test_points_without_a_return_neither_move_the_origin_nor_stay(tmp_path: Path, strays: str):
    count, value = STRAYS[strays]
    xyz = XYZ + UTM_M
    xyz[:count] = value
    write_npy(tmp_path / "7", xyz)
    recording = open_recording(tmp_path)
    frame = recording.frame(0)
    np.testing.assert_allclose(placed(frame), xyz[count:], atol=1e-4)
    origin = np.floor(np.median(xyz[count:], axis=0))
    assert recording.origin == tuple(origin)
    np.testing.assert_allclose(frame.T_world_camera.translation, origin, atol=1e-9)
    # the picture has the points that are ahead
    assert frame.rgb.any(axis=2).mean() > 1e-4


@pytest.mark.parametrize(
    ("shift_m", "is_far"),
    [((0, 0, 0), False), ((350, 350, 0), False), ((0, 0, 600), True), ((-5e5, 0, 0), True)],
)
def test_the_virtual_camera_stands_at_a_sensor_or_at_far_points(
    tmp_path: Path, shift_m: tuple[float, ...], is_far: bool
):
    write_npy(tmp_path / "7", XYZ + shift_m)
    recording = open_recording(tmp_path)
    frame = recording.frame(0)
    assert (frame.T_world_camera is not None, recording.origin is not None) == (is_far, is_far)
    place = frame.T_camera_label.inv().translation
    assert np.abs(place - (np.median(XYZ + shift_m, axis=0) if is_far else 0)).max() < 1


def test_the_origin_is_that_of_the_first_readable_cloud_for_all_frames(tmp_path: Path):
    for number, shift in enumerate((0.0, 4.0, -30.0, 90.0)):
        write_npy(tmp_path / str(number), XYZ + UTM_M + [shift, 0, 0])
    recording = open_recording(tmp_path)
    frames = [recording.frame(i) for i in (3, 0, 2, 1)]
    assert len({tuple(each.T_world_camera.translation) for each in frames}) == 1
    whole = recording.origin
    (tmp_path / "0.npy").write_bytes(b"")
    np.testing.assert_allclose(open_recording(tmp_path).origin, np.add(whole, [4, 0, 0]), atol=1)
    # as a project stores it: nothing changes
    kept = open_recording(tmp_path, ReaderOptions(origin=whole))
    np.testing.assert_array_equal(kept.frame(2).cloud.xyz_m, frames[2].cloud.xyz_m)
    assert kept.origin == whole


def test_a_vehicle_takes_the_camera_along_in_whole_steps(tmp_path: Path):
    """Its points stay precise, and where they are in the map does not depend on the camera."""
    driven = (0.0, 0.9 * STEP_M, 1.2 * STEP_M, 1.4 * STEP_M, 7_003.0, 250_000.0)
    for number, shift in enumerate(driven):
        write_npy(tmp_path / str(number), XYZ + UTM_M + [shift, -shift / 2, 0])
    recording = open_recording(tmp_path)
    first = recording.frame(0).T_world_camera.translation
    steps = []
    for number, shift in enumerate(driven):
        frame = recording.frame(number)
        np.testing.assert_allclose(placed(frame), XYZ + UTM_M + [shift, -shift / 2, 0], atol=1e-4)
        assert np.linalg.norm(np.median(frame.cloud.xyz_m, axis=0)) < 1.1 * STEP_M
        steps.append(((frame.T_world_camera.translation - first) / STEP_M).round(9).tolist())
    assert steps == [[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 0], [70, -35, 0], [2500, -1250, 0]]


def test_a_recording_that_begins_at_its_origin_and_drives_away_keeps_its_points_near(tmp_path: Path):
    for number, shift in enumerate((0, 300, 5_000)):
        write_npy(tmp_path / str(number), XYZ + np.array([shift, 0, 0]))
    recording = open_recording(tmp_path)
    places = [recording.frame(i).T_camera_label.inv().translation.tolist() for i in range(3)]
    np.testing.assert_allclose(places, [[0, 0, 0], [0, 0, 0], [5000, 0, 0]], atol=1e-9)
    assert recording.origin is None


def test_the_option_places_the_camera_and_only_clouds_take_it(tmp_path: Path, generated: Path):
    write_npy(tmp_path / "7", XYZ + UTM_M)
    place = (701_370.0, 4_485_500.0, 642.5)
    frame = open_recording(tmp_path, ReaderOptions(origin=place)).frame(0)
    np.testing.assert_allclose(frame.T_world_camera.translation, place, atol=1e-9)
    np.testing.assert_allclose(placed(frame), XYZ + UTM_M, atol=1e-4)
    with pytest.raises(ConfigError, match="not --origin"):
        open_recording(generated / "people", ReaderOptions(origin=place))


def test_a_calibrated_camera_in_a_map_knows_its_place(tmp_path: Path):
    """The clouds' own calibration is used, and there is nothing to choose."""
    write_npy(tmp_path / "7", XYZ + UTM_M)
    there = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    there[:3, 3] = there[:3, :3] @ -(UTM_M + np.array([0, 0, 1]))
    (tmp_path / "camera_intrinsic.json").write_text(camera_file(cloud_to_camera=there.tolist()))
    recording = open_recording(tmp_path)
    frame = recording.frame(0)
    np.testing.assert_allclose(frame.T_world_camera.translation, UTM_M + np.array([0, 0, 1]), atol=1e-6)
    np.testing.assert_allclose(placed(frame), XYZ + UTM_M, atol=1e-4)
    np.testing.assert_allclose(recording.scan(0).place_m, UTM_M + np.array([0, 0, 1]), atol=1e-6)
    assert recording.origin is None


def test_clouds_of_a_bag_in_map_coordinates_are_precise(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        for number, shift in enumerate((0.0, 4.0)):
            xyz = XYZ + UTM_M + [shift, 0, 0]
            xyz[:300] = 0
            bag.cloud("/points", (1 + number) * 10**9, structured(dict(zip("xyz", xyz.T, strict=True))))
    recording = open_recording(bag.path)
    frames = [recording.frame(i) for i in range(2)]
    for shift, frame in zip((0.0, 4.0), frames, strict=True):
        np.testing.assert_allclose(placed(frame), (XYZ + UTM_M + [shift, 0, 0])[300:], atol=1e-4)
    assert frames[0].T_world_camera.translation.tolist() == frames[1].T_world_camera.translation.tolist()
    around = open_recording(recording.path, ReaderOptions(look_around=4)).frame(1)
    np.testing.assert_allclose(placed(around), placed(frames[1]), atol=2e-4)


def bin_file(folder: Path, xyz: np.ndarray) -> np.ndarray:
    (folder / "a.bin").write_bytes(np.c_[xyz, np.ones(len(xyz))].astype("<f4").tobytes())
    return read_cloud(folder / "a.bin", Scans(4)).xyz_m


def ros_message(folder: Path, xyz: np.ndarray) -> np.ndarray:
    rows = structured(dict(zip("xyz", xyz.astype(np.float32).T, strict=True)))
    return messages.cloud_of(ros_cloud(rows)).xyz_m


@pytest.mark.parametrize("read", [bin_file, ros_message])
def test_points_at_the_sensor_itself_are_left_out(tmp_path: Path, read: Callable[[Path, np.ndarray], np.ndarray]):
    xyz = np.array([[1.0, 2, 3], [0, 0, 0], [0, 0, 1], [np.nan, 0, 0], [np.inf, 1, 1], [-0.0, 0, -0.0], [0, 5, 0]])
    np.testing.assert_array_equal(read(tmp_path, xyz), [[1, 2, 3], [0, 0, 1], [0, 5, 0]])
    with pytest.raises(
        (FrameError, ValueError), match=r"every point is NaN or infinite, or \(0, 0, 0\), which means no return"
    ):
        read(tmp_path, np.zeros((5, 3)))


def test_coordinates_that_a_file_has_rounded_are_noted(tmp_path: Path):
    for name, xyz in (("coarse", (XYZ + UTM_M).astype(np.float32)), ("fine", XYZ + UTM_M), ("near", np.float32(XYZ))):
        (tmp_path / name).mkdir()
        write_npy(tmp_path / name / "1", xyz)
        recording = open_recording(tmp_path / name)
        recording.frame(0)
        expected = "its coordinates, up to 4,485,524 m, are rounded to 0.5 m, as 32-bit floats are; save clouds with"
        assert [note[: len(expected)] for note in recording.notes] == ([expected] if name == "coarse" else []), name


def test_a_cloud_in_millimetres_is_doubted_where_it_gets_an_origin(tmp_path: Path):
    for scale, shift_m, is_told in ((1000.0, 0.0, True), (1.0, 5000.0, False)):
        write_npy(tmp_path / "7", scale * (XYZ + np.array([4.0, 0, 0])) + shift_m)
        for options in (ReaderOptions(), ReaderOptions(look_around=4, camera="around-000")):
            recording = open_recording(tmp_path, options)
            assert recording.notes == ()
            recording.frame(0)
            # look-around tells what its base has found while it read
            assert [note.endswith("from their middle; are they in metres?") for note in recording.notes] == [
                True
            ] * is_told


@pytest.mark.parametrize("name", ["camera_intrinsic.json", "calib/7.txt"])
def test_an_origin_beside_a_calibration_is_refused(tmp_path: Path, name: str):
    write_npy(tmp_path / "7", XYZ)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(camera_file(cloud_to_camera=np.eye(4).tolist()) if "json" in name else OBJECT_CALIB)
    says = f"{Path(name).name} says where the camera is, so --origin is not taken"
    for around in (None, 4):
        with pytest.raises(ConfigError, match=says):
            open_recording(tmp_path, ReaderOptions(origin=(1.0, 2.0, 3.0), look_around=around))
    assert len(open_recording(tmp_path)) == 1
