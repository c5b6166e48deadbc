"""Folders of point clouds: images, calibrations, colours; clouds in map coordinates and their origin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from bag_writer import BagWriter, structured
from cloud_samples import (
    HEIGHT,
    OBJECT_CALIB,
    SCAN,
    WIDTH,
    by_formula,
    camera_file,
    image,
    npy,
    pcd,
    ply,
    put_image,
    ros_cloud,
)

from annotator.geometry.projection import project
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.clouds.virtual_camera import STEP_M, virtual_image
from annotator.recordings.ros import messages
from annotator.recordings.ros.messages import cloud_of as read_message
from annotator.recordings.scan_file import Scans
from annotator.types import Camera, Frame, PointCloud
from annotator.types.errors import ConfigError, FrameError

LIDAR_TO_CAMERA = [[0, -1, 0, 0.1], [0, 0, -1, 0.2], [1, 0, 0, -0.3], [0, 0, 0, 1]]


@pytest.mark.parametrize("place", ["", "velodyne"])
def test_clouds_without_images_are_seen_from_the_lidars_position(tmp_path: Path, place: str):
    folder = tmp_path / place
    folder.mkdir(exist_ok=True)
    for key in ("10", "2"):
        np.save(folder / f"{key}.npy", SCAN)
    recording = open_recording(tmp_path)
    assert (recording.format, recording.keys, recording.root) == ("cloud_folder", ("2", "10"), tmp_path)
    frame = recording.frame(1)
    # all points are kept, also those behind; x forward, y left, z up
    np.testing.assert_allclose(frame.cloud.xyz_m, np.stack([-SCAN[:, 1], -SCAN[:, 2], SCAN[:, 0]], axis=1), atol=1e-6)
    np.testing.assert_array_equal(frame.cloud.reflectance, SCAN[:, 3])
    np.testing.assert_allclose(frame.T_camera_label.apply(SCAN[:, :3].astype(float)), frame.cloud.xyz_m, atol=1e-5)
    np.testing.assert_array_equal(frame.up, [0, -1, 0])
    assert frame.cloud.rgb is None
    # the image shows the points, and almost nothing elsewhere
    ahead = frame.cloud.xyz_m[frame.cloud.xyz_m[:, 2] > 5]
    u, v = np.rint(project(frame.camera, ahead)).astype(int).T
    inside = (u >= 0) & (u < 1280) & (v >= 0) & (v < 720)
    assert inside.sum() > 200
    assert frame.rgb[v[inside], u[inside]].any(axis=1).all()
    assert 0.001 < frame.rgb.any(axis=2).mean() < 0.3


@pytest.mark.parametrize(("calib", "images"), [("calib/7.txt", "image"), ("calib.txt", "points")])
def test_a_cloud_with_an_image_and_kittis_calibration_is_read_as_in_kitti(tmp_path: Path, calib: str, images: str):
    (tmp_path / "points").mkdir()
    (tmp_path / "points" / "7.bin").write_bytes(SCAN.tobytes())
    put_image(tmp_path / images / "7.png", 3)
    (tmp_path / calib).parent.mkdir(exist_ok=True)
    (tmp_path / calib).write_text(OBJECT_CALIB)
    frame = open_recording(tmp_path).frame(0)
    px, inside = by_formula(SCAN)
    np.testing.assert_allclose(project(frame.camera, frame.cloud.xyz_m), px[inside], atol=2e-3)
    u, v = np.rint(px[inside]).astype(int).T
    np.testing.assert_array_equal(frame.cloud.rgb, image(3)[v, u])
    np.testing.assert_array_equal(frame.cloud.reflectance, SCAN[inside, 3])
    np.testing.assert_allclose(frame.T_camera_label.apply(SCAN[inside, :3].astype(float)), frame.cloud.xyz_m, atol=0.02)


def test_a_calibration_without_images_is_the_camera_of_the_drawn_image(tmp_path: Path):
    np.save(tmp_path / "7.npy", SCAN[:, :3])
    (tmp_path / "calib.txt").write_text(OBJECT_CALIB)
    frame = open_recording(tmp_path).frame(0)
    assert (frame.camera.width_px, frame.camera.height_px, len(frame.cloud)) == (123, 35, len(SCAN))
    (tmp_path / "calib.txt").unlink()
    (tmp_path / "camera_intrinsic.json").write_text(camera_file(cloud_to_camera=LIDAR_TO_CAMERA))
    (tmp_path / "gravity.json").write_text('{"up": [0, -2, 0]}')
    frame = open_recording(tmp_path).frame(0)
    assert (frame.camera.width_px, frame.camera.fx) == (WIDTH, 70)
    np.testing.assert_allclose(
        frame.cloud.xyz_m, np.stack([0.1 - SCAN[:, 1], 0.2 - SCAN[:, 2], SCAN[:, 0] - 0.3], axis=1), atol=1e-5
    )
    np.testing.assert_array_equal(frame.up, [0, -1, 0])


def test_clouds_in_the_camera_frame_keep_their_coordinates_and_colours(tmp_path: Path):
    rgb = np.random.default_rng(0).integers(0, 255, (len(SCAN), 3))
    np.save(tmp_path / "7.npy", np.c_[SCAN[:, :3], rgb])
    (tmp_path / "camera_intrinsic.json").write_text(camera_file())
    put_image(tmp_path / "color" / "7.png", 1)
    frame = open_recording(tmp_path).frame(0)
    px = project(frame.camera, SCAN[:, :3].astype(np.float64))
    kept = (SCAN[:, 2] > 0.1) & (px >= -0.5).all(axis=1) & (px < [WIDTH - 0.5, HEIGHT - 0.5]).all(axis=1)
    np.testing.assert_array_equal(frame.cloud.xyz_m, SCAN[kept, :3])
    np.testing.assert_array_equal(frame.cloud.rgb, rgb[kept])
    assert frame.up is None


def calibrated(**more: object) -> Callable[[Path], object]:
    return lambda path: (path / "camera_intrinsic.json").write_text(camera_file(**more))


TURNED = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]
ELSEWHERE = [*LIDAR_TO_CAMERA[:2], [1, 0, 0, -99], LIDAR_TO_CAMERA[3]]
BROKEN = [
    (lambda p: None, "calibration of the images is missing; write camera_intrinsic.json"),
    (calibrated(cloud_to_camera=TURNED), "not a rigid transform"),
    (calibrated(width=99), "the image is 120 x 40 pixels, but the camera is for 99 x 40"),
    (calibrated(cloud_to_camera=ELSEWHERE), r"none of its points lies in the image \(3000 in all\)"),
    (lambda p: (p / "image" / "7.png").unlink(), "missing; put 7.png"),
    (lambda p: np.save(p / "points" / "7.npy", SCAN), r"ambiguous: the folder has 7\.bin, 7\.npy"),
]


@pytest.mark.parametrize(("damage", "complaint"), BROKEN)
def test_a_broken_frame_is_an_error_and_others_are_read(
    tmp_path: Path, damage: Callable[[Path], object], complaint: str
):
    (tmp_path / "points").mkdir()
    for key in ("7", "8"):
        (tmp_path / "points" / f"{key}.bin").write_bytes(SCAN.tobytes())
        put_image(tmp_path / "image" / f"{key}.png", 3)
    damage(tmp_path)
    recording = open_recording(tmp_path)
    with pytest.raises(FrameError, match=complaint):
        recording.frame(0)
    if not (tmp_path / "camera_intrinsic.json").exists():
        (tmp_path / "camera_intrinsic.json").write_text(camera_file(cloud_to_camera=LIDAR_TO_CAMERA))
        assert len(recording.frame(1).cloud) > 10


def test_the_drawn_image_shows_the_nearest_point():
    camera = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)
    xyz = np.array([[0, 0, 4], [0, 0, 1], [0, 0, 2], [0, 0, -1], [9, 0, 1]], np.float32)
    rgb = np.array([[1, 1, 1], [250, 0, 0], [2, 2, 2], [3, 3, 3], [4, 4, 4]], np.uint8)
    picture = virtual_image(camera, PointCloud(xyz, rgb=rgb))
    np.testing.assert_array_equal(picture[14:16, 19:21], np.full((2, 2, 3), [250, 0, 0]))
    assert {tuple(color) for color in picture.reshape(-1, 3)} == {(0, 0, 0), (250, 0, 0)}


N = 12
XYZ = np.random.default_rng(4).uniform(-9, 9, (N, 3)).round(3)
RGB = np.tile(np.array([[224, 16, 16], [16, 224, 16], [16, 16, 224], [255, 0, 7]], np.uint8), (N // 4, 1))
PACKED = RGB.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
NAMES = ("red", "green", "blue")


def of_depth(bits: int) -> np.ndarray:
    """The colours as numbers of so many bits, as writers scale them: the upper bits repeated below."""
    return np.floor(RGB * ((2**bits - 1) / 255) + 0.5)


# type, colours in it
COLUMNS = [
    ("u1", RGB), ("i1", RGB.view(np.int8)), ("u2", RGB), ("u2", of_depth(10)), ("u2", of_depth(14)),
    ("u2", RGB.astype(np.uint16) << 8), ("i2", of_depth(16).astype(np.uint16).view(np.int16)), ("u4", of_depth(32)),
    ("i4", of_depth(16)), ("f4", RGB), ("f4", RGB / 255), ("f8", of_depth(10)),
]  # fmt: skip


def table(kind: str, columns: np.ndarray, names: Sequence[str], order: str = "<") -> np.ndarray:
    fields = [*((name, f"{order}f8") for name in "xyz"), *((name, order + kind) for name in names)]
    rows = np.zeros(N, fields)
    for name, values in zip(("x", "y", "z", *names), [*XYZ.T, *columns.reshape(N, -1).T], strict=True):
        rows[name] = values
    return rows


def read(tmp_path: Path, form: str, rows: np.ndarray) -> RawCloud:
    kind, _, encoding = form.partition(" ")
    if kind == "ros":
        return read_message(ros_cloud(rows))
    content = npy(rows) if kind == "npy" else {"ply": ply, "pcd": pcd}[kind](rows, encoding)
    (tmp_path / f"a.{kind}").write_bytes(content)
    return read_cloud(tmp_path / f"a.{kind}")


FORMS = ["ply ascii", "ply binary_little_endian", "ply binary_big_endian", "pcd ascii", "pcd binary",
         "pcd binary_compressed", "npy", "ros", "ros big"]  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_three_columns(tmp_path: Path, form: str):
    order = ">" if form.endswith(("big", "big_endian")) else "<"
    for kind, colors in COLUMNS:
        cloud = read(tmp_path, form, table(kind, colors, NAMES, order))
        np.testing.assert_array_equal(cloud.rgb, RGB, err_msg=f"{kind} up to {colors.max()}")
        np.testing.assert_allclose(cloud.xyz_m, XYZ)


@pytest.mark.parametrize("form", ["pcd ascii", "pcd binary", "pcd binary_compressed", "npy"])
def test_one_field_of_several_values(tmp_path: Path, form: str):
    for name, values in (("rgb", 3), ("rgba", 4), ("Colors", 3)):
        rows = np.zeros(N, [*((axis, "<f4") for axis in "xyz"), (name, "u1", values)])
        rows["x"], rows["y"], rows["z"], rows[name][:, :3] = *XYZ.T, RGB
        text = "\n".join(" ".join(map(str, (*row.tolist()[:3], *row[name]))) for row in rows)
        body = f"{text}\n".encode() if form == "pcd ascii" else None
        content = npy(rows) if form == "npy" else pcd(rows, form[4:], body)
        (tmp_path / f"a.{form[:3]}").write_bytes(content)
        np.testing.assert_array_equal(read_cloud(tmp_path / f"a.{form[:3]}").rgb, RGB)


ALPHA = np.uint32(0xFF000000)
WHOLE = [(kind, PACKED | alpha) for kind in ("u4", "i4") for alpha in (0, ALPHA, np.uint32(0x7F000000))]
BITS = [("f4", (PACKED | alpha).view(np.float32)) for alpha in (0, ALPHA)]
NUMBERS = [("f4", PACKED.astype(np.float32)), ("f8", PACKED.astype(float)), ("f8", (PACKED | ALPHA).astype(float))]


@pytest.mark.parametrize("form", [form for form in FORMS if form != "ply ascii" and form != "pcd ascii"])
def test_packed_colours(tmp_path: Path, form: str):
    order = ">" if form.endswith(("big", "big_endian")) else "<"
    for number, (kind, packed) in enumerate(WHOLE + BITS + NUMBERS):
        name = ("rgb", "rgba")[number % 2]
        rows = table(kind, np.zeros((N, 1)), [name], order)
        rows[name] = packed.view(np.int32) if kind == "i4" else packed
        np.testing.assert_array_equal(read(tmp_path, form, rows).rgb, RGB, err_msg=f"{name} {kind} {packed[0]}")


def lines(texts: Sequence[str]) -> bytes:
    return "".join(f"{x} {y} {z} {text}\n" for (x, y, z), text in zip(XYZ.tolist(), texts, strict=True)).encode()


FLOATS = PACKED.view(np.float32)
TEXTS = [
    pytest.param("f4", [str(each) for each in PACKED], id="whole"),
    pytest.param("u4", [str(each) for each in (PACKED | ALPHA).view(np.int32)], id="negative-U"),
    pytest.param("i4", [str(each) for each in PACKED | ALPHA], id="large-I"),
    pytest.param("f4", [f"{each:.9e}" for each in PACKED], id="scientific"),
    pytest.param("f4", [f"{each:.9g}" for each in FLOATS], id="bits"),
]


@pytest.mark.parametrize(("kind", "texts"), TEXTS)
def test_packed_colours_in_text(tmp_path: Path, kind: str, texts: list[str]):
    (tmp_path / "a.pcd").write_bytes(pcd(table(kind, np.zeros((N, 1)), ["rgb"]), "ascii", lines(texts)))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").rgb, RGB)


@pytest.mark.parametrize("nan", ["nan", "-1.#IND", "1.#R", "-nan(ind)"])
def test_nan_is_black_among_colours_and_no_point_among_coordinates(tmp_path: Path, nan: str):
    body = lines([nan, *map(str, PACKED[1:])]).splitlines(keepends=True)
    body[1] = f"1 {nan} 2 7\n".encode()
    (tmp_path / "a.pcd").write_bytes(pcd(table("f4", np.zeros((N, 1)), ["rgb"]), "ascii", b"".join(body)))
    cloud = read_cloud(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.rgb, [[0, 0, 0], *RGB[2:]])
    np.testing.assert_array_equal(cloud.xyz_m, np.delete(XYZ, 1, 0))


def test_reflectances_that_are_all_saturated_are_none():
    for highest in (255, 65535):
        columns = dict(zip("xyz", XYZ.T, strict=True)) | {"intensity": np.full(N, highest, np.uint16)}
        assert from_columns(columns).reflectance is None
        columns["intensity"][0] = 5
        assert from_columns(columns).reflectance is not None


@pytest.mark.parametrize(("place", "named"), [("inside", "vertex"), ("before", "other")])
def test_lists_before_the_end_of_the_vertices_are_refused(tmp_path: Path, place: str, named: str):
    listed = "property list uchar float d\n"
    before = f"element other 1\n{listed}" if place == "before" else ""
    content = ply(table("u1", RGB, NAMES), "binary_little_endian", before, listed if place == "inside" else "")
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(FrameError, match=rf"its {named} elements have lists, .*; save it without"):
        read_cloud(tmp_path / "a.ply")


UTM_M = np.array([701_378.25, 4_485_513.5, 640.75])
# The coordinates of a floor and a wall around (0, 0, 0); UTM coordinates need 64 bits.
NEAR = np.random.default_rng(3).uniform((-10, -10, -1.6), (10, 10, 0), (1001, 3))


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
    xyz = NEAR + UTM_M
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
    write_npy(tmp_path / "7", NEAR + shift_m)
    recording = open_recording(tmp_path)
    frame = recording.frame(0)
    assert (frame.T_world_camera is not None, recording.origin is not None) == (is_far, is_far)
    place = frame.T_camera_label.inv().translation
    assert np.abs(place - (np.median(NEAR + shift_m, axis=0) if is_far else 0)).max() < 1


def test_the_origin_is_that_of_the_first_readable_cloud_for_all_frames(tmp_path: Path):
    for number, shift in enumerate((0.0, 4.0, -30.0, 90.0)):
        write_npy(tmp_path / str(number), NEAR + UTM_M + [shift, 0, 0])
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
        write_npy(tmp_path / str(number), NEAR + UTM_M + [shift, -shift / 2, 0])
    recording = open_recording(tmp_path)
    first = recording.frame(0).T_world_camera.translation
    steps = []
    for number, shift in enumerate(driven):
        frame = recording.frame(number)
        np.testing.assert_allclose(placed(frame), NEAR + UTM_M + [shift, -shift / 2, 0], atol=1e-4)
        assert np.linalg.norm(np.median(frame.cloud.xyz_m, axis=0)) < 1.1 * STEP_M
        steps.append(((frame.T_world_camera.translation - first) / STEP_M).round(9).tolist())
    assert steps == [[0, 0, 0], [1, 0, 0], [1, -1, 0], [1, -1, 0], [70, -35, 0], [2500, -1250, 0]]


def test_a_recording_that_begins_at_its_origin_and_drives_away_keeps_its_points_near(tmp_path: Path):
    for number, shift in enumerate((0, 300, 5_000)):
        write_npy(tmp_path / str(number), NEAR + np.array([shift, 0, 0]))
    recording = open_recording(tmp_path)
    places = [recording.frame(i).T_camera_label.inv().translation.tolist() for i in range(3)]
    np.testing.assert_allclose(places, [[0, 0, 0], [0, 0, 0], [5000, 0, 0]], atol=1e-9)
    assert recording.origin is None


def test_the_option_places_the_camera_and_only_clouds_take_it(tmp_path: Path, generated: Path):
    write_npy(tmp_path / "7", NEAR + UTM_M)
    place = (701_370.0, 4_485_500.0, 642.5)
    frame = open_recording(tmp_path, ReaderOptions(origin=place)).frame(0)
    np.testing.assert_allclose(frame.T_world_camera.translation, place, atol=1e-9)
    np.testing.assert_allclose(placed(frame), NEAR + UTM_M, atol=1e-4)
    with pytest.raises(ConfigError, match="not --origin"):
        open_recording(generated / "people", ReaderOptions(origin=place))


def test_a_calibrated_camera_in_a_map_knows_its_place(tmp_path: Path):
    """The clouds' own calibration is used, and there is nothing to choose."""
    write_npy(tmp_path / "7", NEAR + UTM_M)
    there = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    there[:3, 3] = there[:3, :3] @ -(UTM_M + np.array([0, 0, 1]))
    (tmp_path / "camera_intrinsic.json").write_text(camera_file(cloud_to_camera=there.tolist()))
    recording = open_recording(tmp_path)
    frame = recording.frame(0)
    np.testing.assert_allclose(frame.T_world_camera.translation, UTM_M + np.array([0, 0, 1]), atol=1e-6)
    np.testing.assert_allclose(placed(frame), NEAR + UTM_M, atol=1e-4)
    np.testing.assert_allclose(recording.scan(0).place_m, UTM_M + np.array([0, 0, 1]), atol=1e-6)
    assert recording.origin is None


def test_clouds_of_a_bag_in_map_coordinates_are_precise(tmp_path: Path):
    with BagWriter(tmp_path, "mcap") as bag:
        for number, shift in enumerate((0.0, 4.0)):
            xyz = NEAR + UTM_M + [shift, 0, 0]
            xyz[:300] = 0
            bag.cloud("/points", (1 + number) * 10**9, structured(dict(zip("xyz", xyz.T, strict=True))))
    recording = open_recording(bag.path)
    frames = [recording.frame(i) for i in range(2)]
    for shift, frame in zip((0.0, 4.0), frames, strict=True):
        np.testing.assert_allclose(placed(frame), (NEAR + UTM_M + [shift, 0, 0])[300:], atol=1e-4)
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
    for name, xyz in (
        ("coarse", (NEAR + UTM_M).astype(np.float32)),
        ("fine", NEAR + UTM_M),
        ("near", np.float32(NEAR)),
    ):
        (tmp_path / name).mkdir()
        write_npy(tmp_path / name / "1", xyz)
        recording = open_recording(tmp_path / name)
        recording.frame(0)
        expected = "its coordinates, up to 4,485,524 m, are rounded to 0.5 m, as 32-bit floats are; save clouds with"
        assert [note[: len(expected)] for note in recording.notes] == ([expected] if name == "coarse" else []), name


def test_a_cloud_in_millimetres_is_doubted_where_it_gets_an_origin(tmp_path: Path):
    for scale, shift_m, is_told in ((1000.0, 0.0, True), (1.0, 5000.0, False)):
        write_npy(tmp_path / "7", scale * (NEAR + np.array([4.0, 0, 0])) + shift_m)
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
    write_npy(tmp_path / "7", NEAR)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(camera_file(cloud_to_camera=np.eye(4).tolist()) if "json" in name else OBJECT_CALIB)
    says = f"{Path(name).name} says where the camera is, so --origin is not taken"
    for around in (None, 4):
        with pytest.raises(ConfigError, match=says):
            open_recording(tmp_path, ReaderOptions(origin=(1.0, 2.0, 3.0), look_around=around))
    assert len(open_recording(tmp_path)) == 1
