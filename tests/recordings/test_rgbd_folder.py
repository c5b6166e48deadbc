"""RGB-D folders and TUM's: the content of a frame, pairs by time, depth of another camera, damaged files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import small_recordings as made
from hypothesis import given
from hypothesis import strategies as st
from rgbd_samples import png, write_rgbd
from scipy.spatial.transform import RigidTransform, Rotation
from small_recordings import START_S

from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.recordings.recording import ReaderOptions
from annotator.recordings.two_cameras import registered
from annotator.types import Camera
from annotator.types.errors import FrameError, RecordingError, UnclearError
from annotator.workflows.checking.dataset_check import check_datasets

WIDTH, HEIGHT = 12, 8
INTRINSICS = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": [10.0, 0, 0, 0, 11.0, 0, 5.5, 3.5, 1]}


@pytest.fixture
def color() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)


@pytest.fixture
def depth() -> np.ndarray:
    depth = np.random.default_rng(1).integers(500, 4000, (HEIGHT, WIDTH)).astype(np.uint16)
    depth[2, 3] = depth[0] = 0
    return depth


@pytest.fixture
def folder(tmp_path: Path, color: np.ndarray, depth: np.ndarray) -> Path:
    """A recording of the frames 000000 and 000001, with the same image."""
    return write_rgbd(tmp_path, dict.fromkeys(("000000", "000001"), (color, depth)), **INTRINSICS)


def test_a_frame_has_its_image_depth_and_coloured_cloud(folder: Path, color: np.ndarray, depth: np.ndarray):
    recording = open_recording(folder)
    frame = recording.frame(1)
    assert (recording.name, frame.key, frame.index) == (folder.name, "000001", 1)
    np.testing.assert_array_equal(frame.rgb, color)  # RGB, not OpenCV's order
    np.testing.assert_allclose(frame.depth_m, depth / 1000, atol=1e-6)
    camera = frame.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10.0, 11.0, 5.5, 3.5)  # column by column
    assert (frame.up, frame.T_camera_label, frame.timestamp_ns) == (None, None, None)
    cloud = frame.cloud
    assert len(cloud) == np.count_nonzero(depth)
    v, u = np.divmod(cloud.pixel_index, WIDTH)
    np.testing.assert_array_equal(cloud.rgb, color[v, u])
    np.testing.assert_allclose(cloud.xyz_m[:, 2], depth[v, u] / 1000, atol=1e-6)
    np.testing.assert_allclose(project(camera, cloud.xyz_m), np.stack([u, v], axis=1), atol=1e-4)


def test_depth_scale_and_distortion_are_those_of_the_camera_file(folder: Path, depth: np.ndarray):
    more = {"depth_scale": 5000, "distortion": [0.1, -0.2, 0.001, 0.002, 0.03]}
    (folder / "camera_intrinsic.json").write_text(json.dumps(INTRINSICS | more))
    frame = open_recording(folder).frame(0)
    np.testing.assert_allclose(frame.depth_m, depth / 5000, atol=1e-6)
    assert frame.camera.distortion == tuple(more["distortion"])
    v, u = np.divmod(frame.cloud.pixel_index, WIDTH)
    np.testing.assert_allclose(project(frame.camera, frame.cloud.xyz_m), np.stack([u, v], axis=1), atol=1e-3)


@pytest.mark.parametrize("place", [".", ".."])
def test_a_camera_file_of_another_name_is_used_if_it_is_the_only_one(folder: Path, tmp_path: Path, place: str):
    inner = folder / "scene"
    inner.mkdir()
    for name in ("color", "depth"):
        (folder / name).rename(inner / name)
    (folder / "camera_intrinsic.json").rename(inner / place / "camera_primesense.json")
    (inner / place / "camera_to_person.json").write_text("{}")  # no camera: has no intrinsic matrix
    assert open_recording(inner).frame(0).camera.fx == 10.0
    (inner / place / "camera_other.json").write_text(json.dumps(INTRINSICS))
    with pytest.raises(FrameError, match=r"several cameras \(camera_other.json, camera_primesense.json\)"):
        open_recording(inner).frame(0)


def test_depth_of_another_size_shows_the_same_unless_a_file_says_otherwise(folder: Path, color: np.ndarray):
    small = 1500 + 5 * np.arange(6, dtype=np.uint16).reshape(2, 3)
    for key in ("000000", "000001"):
        (folder / "depth" / f"{key}.png").write_bytes(png(small))
    recording = open_recording(folder)
    frame = recording.frame(0)
    assert recording.notes[0].startswith("The depth images of 3 x 2 pixels are taken to show the same")
    # a depth pixel is a block of four by four pixels of the image
    np.testing.assert_allclose(project(frame.camera, frame.cloud.xyz_m)[1], [5.5, 1.5], atol=1e-5)
    np.testing.assert_allclose(frame.cloud.xyz_m[:, 2], small.ravel() / 1000)
    assert frame.cloud.pixel_index is None
    v, u = np.nonzero(frame.depth_m)
    np.testing.assert_array_equal(frame.cloud.rgb, color[v, u])
    np.testing.assert_array_equal(frame.depth_m[v, u], frame.cloud.xyz_m[:, 2])
    # a depth camera 0.4 m to the left of the colour camera, with a wider view, and two units a millimetre
    pose = [[1, 0, 0, -0.4], [0, 1, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]]
    content = {"width": 3, "height": 2, "intrinsic_matrix": [4.0, 0, 0, 0, 4.0, 0, 1, 0.5, 1]}
    content |= {"depth_scale": 2000, "depth_to_color": pose}
    (folder / "depth_intrinsic.json").write_text(json.dumps(content))
    frame = recording.frame(0)
    assert recording.notes == ()
    x = (np.array([0, 1, 2]) - 1) / 4 * small / 2000 - 0.4
    y = np.array([[-0.5], [0.5]]) / 4 * small / 2000
    expected = np.stack([x, y, small / 2000 + 0.05], axis=-1).reshape(-1, 3)
    expected = expected[(np.abs(project(frame.camera, expected) - [5.5, 3.5]) <= [6, 4]).all(axis=1)]
    assert len(expected) == 4  # the left column is outside the image
    np.testing.assert_allclose(frame.cloud.xyz_m, expected, atol=1e-6)


def test_a_missing_image_affects_only_its_frame(folder: Path):
    (folder / "depth" / "000000.png").unlink()
    (folder / "color" / "000001.png").rename(folder / "color" / "000002.png")
    (folder / "depth" / "000002.png").write_bytes((folder / "depth" / "000001.png").read_bytes())
    recording = open_recording(folder)
    assert recording.keys == ("000000", "000001", "000002")
    with pytest.raises(FrameError, match=r"depth/000000\.png: missing; put 000000\.png beside color/000000\.png"):
        recording.frame(0)
    with pytest.raises(FrameError, match=r"color/000001\.png: missing; .* beside depth/000001\.png"):
        recording.frame(1)
    assert recording.frame(2).key == "000002"


def test_sun_rgbds_rotated_depth_is_noticed(folder: Path, depth: np.ndarray):
    """Its bits are rotated by three: read as millimetres, the room was 8 to 64 m away."""
    rotated = depth << np.uint16(3) | depth >> np.uint16(13)
    for key in ("000000", "000001"):
        (folder / "depth" / f"{key}.png").write_bytes(png(rotated))
    with pytest.raises(UnclearError, match=r"depth reaches 3\d\.\d m in steps of 8 units, as in SUN RGB-D") as caught:
        open_recording(folder).frame(0)
    assert '"depth_encoding": "sunrgbd"' in str(caught.value)
    assert [finding.rule for finding in check_datasets(folder).findings] == ["unclear-file", "unclear-file"]
    for encoding, expected in (("sunrgbd", depth / 1000), ("plain", rotated / 1000)):
        camera = json.dumps(INTRINSICS | {"depth_encoding": encoding})
        (folder / "camera_intrinsic.json").write_text(camera)
        np.testing.assert_allclose(open_recording(folder).frame(0).depth_m, expected, atol=1e-5)


DEPTH_CAMERA = Camera(64, 48, 60.0, 61.0, 31.0, 23.5)
COLOR_CAMERA = Camera(160, 120, 140.0, 141.0, 80.0, 58.0, (0.05, -0.02, 0.001, -0.001))


def pose(shift_m: list[float], turn_rad: list[float]) -> RigidTransform:
    return RigidTransform.from_components(np.array(shift_m), Rotation.from_rotvec(turn_rad))


def picture(camera: Camera) -> np.ndarray:
    """A colour for each pixel that tells where it is."""
    v, u = np.mgrid[: camera.height_px, : camera.width_px]
    return np.stack([u, v, (u ^ v)], axis=-1).astype(np.uint8)


small = st.floats(-0.1, 0.1)


@given(st.lists(small, min_size=3, max_size=3), st.lists(small, min_size=3, max_size=3), st.integers(0, 99))
def test_each_point_is_a_measured_pixel_with_the_colour_that_it_projects_to(
    shift_m: list[float], turn_rad: list[float], seed: int
):
    random = np.random.default_rng(seed)
    depth_m = random.uniform(0.5, 3.0, (DEPTH_CAMERA.height_px, DEPTH_CAMERA.width_px)).astype(np.float32)
    depth_m[random.random(depth_m.shape) < 0.2] = random.choice([0.0, -1.0, np.nan, np.inf])
    T_color_depth, rgb = pose(shift_m, turn_rad), picture(COLOR_CAMERA)
    cloud, in_color_m = registered(depth_m, DEPTH_CAMERA, T_color_depth, rgb, COLOR_CAMERA)
    back = T_color_depth.inv().apply(cloud.xyz_m)
    px = project(DEPTH_CAMERA, back)
    u, v = np.rint(px).astype(int).T
    np.testing.assert_allclose(px, np.c_[u, v], atol=1e-2)
    np.testing.assert_allclose(back[:, 2], depth_m[v, u], rtol=1e-5)
    assert len({*zip(u, v, strict=True)}) == len(cloud)
    px = project(COLOR_CAMERA, cloud.xyz_m)
    clear = (np.abs(px % 1 - 0.5) > 1e-3).all(axis=1)
    u, v = np.rint(px[clear]).astype(int).T
    np.testing.assert_array_equal(cloud.rgb[clear], rgb[v, u])
    assert cloud.pixel_index is None
    # each pixel holds the nearest of its points
    expected = np.full(in_color_m.shape, np.inf, np.float32)
    u, v = np.floor(px + 0.5).astype(int).clip(0).T
    np.minimum.at(
        expected, (v.clip(max=COLOR_CAMERA.height_px - 1), u.clip(max=COLOR_CAMERA.width_px - 1)), cloud.xyz_m[:, 2]
    )
    expected[np.isinf(expected)] = 0
    assert (expected != in_color_m).mean() < 1e-3


def test_points_outside_the_image_or_hidden_from_it_are_left_out():
    depth_m = np.full((48, 64), 2.0, np.float32)
    depth_m[:, 28:36] = 1.0  # a post before a wall
    T_color_depth = pose([-0.1, 0.0, 0.0], [0, 0, 0])
    cloud, in_color_m = registered(depth_m, DEPTH_CAMERA, T_color_depth, picture(COLOR_CAMERA), COLOR_CAMERA)
    middle = np.abs(cloud.xyz_m[:, 1]) < 0.2
    columns = np.rint(project(DEPTH_CAMERA, T_color_depth.inv().apply(cloud.xyz_m[middle]))[:, 0]).astype(int)
    # in the colour camera, the post lies 6 columns of the depth image further left, the wall 3
    missing = {*range(64)} - {*columns}
    assert {25, 26, 27} <= missing <= {0, 24, 25, 26, 27}
    assert set(np.unique(in_color_m)) == {0.0, 1.0, 2.0}  # nothing between the post and the wall
    aside, _ = registered(depth_m, DEPTH_CAMERA, pose([1.5, 0, 0], [0, 0, 0]), picture(COLOR_CAMERA), COLOR_CAMERA)
    assert 0 < len(aside) < len(cloud) / 2
    behind, nothing = registered(
        depth_m, DEPTH_CAMERA, pose([0, 0, -3], [0, 0, 0]), picture(COLOR_CAMERA), COLOR_CAMERA
    )
    assert len(behind) == 0 and not nothing.any()


def tum_image(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 255, (480, 640, 3)).astype(np.uint8)


def tum_depth(number: int) -> np.ndarray:
    raw = np.random.default_rng(number).integers(2500, 20_000, (480, 640)).astype(np.uint16)
    raw[:100] = 0
    return raw


def write_tum(folder: Path, rgb_ms: list[int], depth_ms: list[int], images: made.Draw = tum_image) -> Path:
    return made.write_tum(folder, rgb_ms, depth_ms, images, tum_depth)


def test_images_are_paired_by_time_and_depth_has_5000_units_per_metre(tmp_path: Path):
    path = write_tum(tmp_path / "rgbd_dataset_freiburg1_xyz", [0, 33, 66, 133], [12, 41, 97, 130])
    recording = open_recording(path)
    assert (recording.format, recording.is_sequence) == ("tum_rgbd", True)
    assert recording.keys == ("1305031102.000000", "1305031102.033000", "1305031102.133000")
    assert recording.notes == ("Left out: 1 colour image without a depth image within 0.02 s.",)
    for i, (color, partner) in enumerate(((0, 0), (1, 1), (3, 3))):
        frame = recording.frame(i)
        np.testing.assert_array_equal(frame.rgb, tum_image(color))
        np.testing.assert_array_equal(frame.depth_m, (tum_depth(partner) / np.float32(5000)).astype(np.float32))
        assert len(frame.cloud) == np.count_nonzero(tum_depth(partner)) == len(frame.cloud.pixel_index)
    assert frame.timestamp_ns == START_S * 10**9 + 133_000_000
    assert (frame.camera.fx, frame.camera.cx, frame.camera.cy) == (525.0, 319.5, 239.5)
    # the camera looks down by about 27 degrees
    np.testing.assert_allclose(
        frame.up, Rotation.from_quat([0.6132, 0.5962, -0.3311, -0.3986]).as_matrix()[2], atol=1e-6
    )
    assert frame.up[1] < -0.85 and frame.up[2] == pytest.approx(-np.sin(np.radians(27.6)), abs=0.01)
    wider = open_recording(path, ReaderOptions(tolerance_s=0.05))
    assert (len(wider), wider.notes) == (4, ())
    with pytest.raises(
        RecordingError, match=r"no frames; none of its colour images \(4\) has .* within 0\.001 s; give a larger"
    ):
        open_recording(path, ReaderOptions(tolerance_s=0.001))


def test_other_recordings_have_their_own_camera_and_no_known_gravity(tmp_path: Path):
    path = write_tum(tmp_path / "lab", [0], [1])
    recording = open_recording(path)
    assert "write camera_intrinsic.json for others" in recording.notes[0]
    assert recording.frame(0).up is None
    camera = {"width": 640, "height": 480, "intrinsic_matrix": [500.0, 0, 0, 0, 501.0, 0, 320, 240, 1]}
    (path / "camera_intrinsic.json").write_text(json.dumps(camera))
    frame = recording.frame(0)
    assert (frame.camera.fx, recording.notes) == (500.0, ())
    assert frame.depth_m.max() == tum_depth(0).max() / np.float32(5000)
    (path / "camera_intrinsic.json").write_text(json.dumps(camera | {"depth_scale": 1000}))
    assert recording.frame(0).depth_m.max() == tum_depth(0).max() / np.float32(1000)


def test_folders_may_be_linked_into_the_recording_but_not_lead_further(tmp_path: Path):
    path = write_tum(tmp_path / "freiburg", [0, 33], [1, 34])
    (path / "rgb").rename(tmp_path / "elsewhere")
    (path / "rgb").symlink_to(tmp_path / "elsewhere")
    np.testing.assert_array_equal(open_recording(path).frame(0).rgb, tum_image(0))
    (tmp_path / "elsewhere").rename(tmp_path / "further")
    (tmp_path / "elsewhere").mkdir()
    for file in (tmp_path / "further").iterdir():
        (tmp_path / "elsewhere" / file.name).symlink_to(file)
    with pytest.raises(FrameError, match="leads out of the folder"):
        open_recording(path).frame(0)


@pytest.mark.parametrize(
    "changed",
    [
        lambda text: text.replace(" ", ", "),
        lambda text: text.replace(" ", ","),
        lambda text: text.replace("rgb/", "./rgb/"),
        lambda text: text.replace(".png", ".png 1 2"),
    ],
    ids=["commas-blanks", "commas", "point", "columns"],
)
def test_lists_of_other_tools_are_read(tmp_path: Path, changed: Callable[[str], str]):
    path = write_tum(tmp_path / "freiburg", [0, 33], [1, 34], tum_small)
    before = open_recording(path)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        comments, _, rows = (path / name).read_text().rpartition("#")
        comment, _, rows = rows.partition("\n")
        (path / name).write_bytes(changed(f"{comments}#{comment}\n{rows}").encode())
    after = open_recording(path)
    assert (after.keys, after.times_ns) == (before.keys, before.times_ns)
    np.testing.assert_array_equal(after.poses.quaternions, before.poses.quaternions)
    assert [file.is_file() for i in range(2) for file in after.files(i)] == [True] * 4


def tum_small(number: int) -> np.ndarray:
    return tum_image(number)[:8, :8]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("depth.txt", "1305031102000000000 a.png", r"depth\.txt:1: the time \d+ s is beyond the year 2262"),
        ("rgb.txt", "1305031102,25 rgb/a.png", r"rgb\.txt:1: begins with a time with a decimal comma; write a point"),
        ("groundtruth.txt", "1305031102 0 0 0 0,5 0,5 0,5 0,5", r"groundtruth\.txt:1: must be a time, a place"),
        ("groundtruth.txt", "1305031102 0 0 0 2 0.6 -0.3 -0.4", r"groundtruth\.txt:1: must be a unit quaternion, but"),
    ],
)
def test_decimal_commas_and_nanoseconds_are_refused(tmp_path: Path, name: str, text: str, says: str):
    path = write_tum(tmp_path / "freiburg", [0], [1], tum_small)
    (path / name).write_text(text)
    with pytest.raises(RecordingError, match=says):
        open_recording(path)
