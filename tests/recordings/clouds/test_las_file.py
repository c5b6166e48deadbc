"""LAS and LAZ: files written by laspy are read; damaged files cause no crash, endless loop or large memory use."""

from __future__ import annotations

import io
import struct
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import strategies as st

from annotator.geometry.projection import project
from annotator.recordings import open_recording
from annotator.recordings.clouds import las_file
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.las_file import parse_las
from annotator.types.errors import FrameError, MissingExtraError

COUNT = 300
RANDOM = np.random.default_rng(0)
XYZ = np.round(RANDOM.normal(0, 20, (COUNT, 3)), 3)
INTENSITY = RANDOM.integers(0, 65536, COUNT).astype(np.uint16)
RGB = RANDOM.integers(0, 256, (COUNT, 3)).astype(np.uint8)
# A position in map coordinates (UTM zone 32), metres.
FAR_M = np.array([512_000.0, 5_403_000.0, 250.0])
# LAS version -> point formats, with and without colours, and one with more bytes than the format has
FORMATS = [("1.2", 0, 0), ("1.2", 3, 0), ("1.4", 6, 0), ("1.4", 7, 2), ("1.4", 8, 0)]


@lru_cache
def written(
    version: str, point_format: int, more: int, is_compressed: bool, at_m: tuple[float, ...] = (0, 0, 0)
) -> bytes:
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001, 0.001, 0.001], np.array([10.0, 20.0, 0.0]) + at_m
    for number in range(more):
        header.add_extra_dim(laspy.ExtraBytesParams(f"more{number}", "u1"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (XYZ + at_m).T
    cloud.intensity = INTENSITY
    if "red" in cloud.point_format.dimension_names:
        cloud.red, cloud.green, cloud.blue = RGB.T.astype(np.uint16) << 8
    out = io.BytesIO()
    cloud.write(out, do_compress=is_compressed, laz_backend=laspy.LazBackend.Lazrs if is_compressed else None)
    return out.getvalue()


@pytest.mark.parametrize("suffix", [".las", ".LAZ"])
@pytest.mark.parametrize(("version", "point_format", "more"), FORMATS)
def test_files_written_by_laspy_are_read(tmp_path: Path, version: str, point_format: int, more: int, suffix: str):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(written(version, point_format, more, suffix == ".LAZ"))
    read = read_cloud(path)
    np.testing.assert_allclose(read.xyz_m, XYZ, atol=1e-9)
    np.testing.assert_allclose(read.reflectance, INTENSITY / 65535, atol=1e-6)
    if point_format in (3, 7, 8):
        np.testing.assert_array_equal(read.rgb, RGB)
    else:
        assert read.rgb is None


def test_withheld_points_8_bit_colours_and_empty_columns_are_handled(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(las_file, "POINTS_AT_ONCE", 128)
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = [0.001] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
    cloud.red, cloud.green, cloud.blue = RGB.T
    cloud.withheld = np.arange(COUNT) % 3 == 0
    out = io.BytesIO()
    cloud.write(out)
    read = parse_las(Path("a.las"), out.getvalue())
    np.testing.assert_allclose(read.xyz_m, XYZ[np.arange(COUNT) % 3 > 0], atol=1e-9)
    np.testing.assert_array_equal(read.rgb, RGB[np.arange(COUNT) % 3 > 0])
    assert read.reflectance is None


def test_clouds_in_map_coordinates_are_seen_from_the_median_of_their_points(tmp_path: Path):
    for key, suffix in (("2", ".las"), ("10", ".laz")):
        (tmp_path / f"{key}{suffix}").write_bytes(written("1.4", 7, 2, suffix == ".laz", tuple(FAR_M)))
    recording = open_recording(tmp_path)
    assert (recording.format, recording.keys) == ("cloud_folder", ("2", "10"))
    frame = recording.frame(1)
    # the precision is below a millimetre, which float32 map coordinates would not allow
    back = frame.T_camera_label.inv().apply(frame.cloud.xyz_m.astype(float))
    np.testing.assert_allclose(back, XYZ + FAR_M, atol=1e-4)
    np.testing.assert_array_equal(frame.up, [0, -1, 0])
    assert np.abs(np.median(frame.cloud.xyz_m, axis=0)).max() <= 1
    u, v = np.rint(project(frame.camera, frame.cloud.xyz_m[frame.cloud.xyz_m[:, 2] > 5])).astype(int).T
    inside = (u >= 0) & (u < 1280) & (v >= 0) & (v < 720)
    assert inside.sum() > 20
    assert frame.rgb[v[inside], u[inside]].any(axis=1).all()


LIMITS = (2**31 - 1, -(2**31))


def saturated(axes: str, count: int, limit: int) -> bytes:
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [0.001] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
    for axis in axes:
        cloud[axis.upper()][:count] = limit
    out = io.BytesIO()
    cloud.write(out)
    return out.getvalue()


@pytest.mark.parametrize("limit", LIMITS)
@pytest.mark.parametrize(
    ("axes", "count", "left"),
    [
        ("y", 2, COUNT - 2),
        ("y", COUNT, 0),
        ("z", COUNT // 50, 0),
        ("xyz", COUNT // 2, COUNT - COUNT // 2),
        ("xyz", COUNT, 0),
    ],
)
def test_coordinates_at_the_limits_of_their_type_are_no_points(axes: str, count: int, left: int, limit: int):
    """Few: left out. Many of one axis: saturated. Any number of all three axes: no return."""
    content = saturated(axes, count, limit)
    if left:
        np.testing.assert_allclose(parse_las(Path("a.las"), content).xyz_m, XYZ[count:], atol=1e-9)
        return
    with pytest.raises(
        FrameError, match=rf"saturated: {axes[0]} is at the limit of int32 in {count} of {COUNT} points"
    ):
        parse_las(Path("a.las"), content)


def test_a_saturated_laz_file_is_refused_in_the_same_words():
    content = laspy.read(io.BytesIO(saturated("y", COUNT, LIMITS[0])))
    out = io.BytesIO()
    content.write(out, do_compress=True, laz_backend=laspy.LazBackend.Lazrs)
    with pytest.raises(FrameError, match=rf"a\.laz: its coordinates are saturated: y is .* {COUNT} points; save it"):
        parse_las(Path("a.laz"), out.getvalue())


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_colours_use_their_own_range(bits: int):
    header = laspy.LasHeader(point_format=2, version="1.2")
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
    cloud.red, cloud.green, cloud.blue = np.floor(RGB.T * ((2**bits - 1) / 255) + 0.5).astype(np.uint16)
    out = io.BytesIO()
    cloud.write(out)
    np.testing.assert_array_equal(parse_las(Path("a.las"), out.getvalue()).rgb, RGB)


def test_an_intensity_of_255_everywhere_is_none():
    header = laspy.LasHeader(point_format=3, version="1.2")
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
    cloud.intensity = np.full(COUNT, 255)
    out = io.BytesIO()
    cloud.write(out)
    assert parse_las(Path("a.las"), out.getvalue()).reflectance is None


def test_a_crash_of_the_decoder_is_an_error_of_the_file(tmp_path: Path):
    """Found by `scripts/fuzz files`: on these bytes lazrs reads memory that is not its own."""
    sound = written("1.2", 3, 0, True)
    damaged = sound[:2015] + b"\xff" * 2024 + sound[4039:]
    with pytest.raises(FrameError, match=r"a\.laz: its points are damaged \(the decoder crashed on them\); save"):
        parse_las(tmp_path / "a.laz", damaged)
    assert len(parse_las(tmp_path / "a.laz", sound).xyz_m) == COUNT


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "lazrs", None)
    with pytest.raises(MissingExtraError, match=r"laspy\[lazrs\] is not installed; .*scripts/setup las"):
        parse_las(Path("a.las"), b"")


def start_of(data: bytes) -> int:
    return int(struct.unpack_from("<I", data, 96)[0])


def patched(data: bytes, at: int, code: str, value: int) -> bytes:
    return data[:at] + struct.pack(f"<{code}", value) + data[at + struct.calcsize(f"<{code}") :]


HUGE = 2**32 - 1
OLD, NEW = written("1.2", 3, 0, True), written("1.4", 7, 2, True)
# Each would crash the program or block it for hours if it were not checked.
FALSE_HEADERS = [
    (b"", "is not a LAS file"),
    (b"LASF" + bytes(300), "position of the points, byte 0"),
    (written("1.2", 3, 0, False)[:-1], "declares 300 points of 34 bytes"),
    (patched(written("1.2", 3, 0, False), 107, "I", HUGE), f"declares {HUGE} points"),
    (patched(written("1.4", 6, 0, False), 247, "Q", 2**63), f"declares {2**63} points"),
    (patched(OLD, 100, "I", HUGE), "records before its points"),
    (patched(OLD, 96, "I", HUGE), "position of the points, byte"),
    (patched(OLD, 107, "I", 2**25), "33554432 points take about 4096 MiB"),
    (OLD[: len(OLD) // 2], "cannot be read as LAS or LAZ"),
    (patched(OLD, 105, "H", 33), "cannot be read as LAS or LAZ"),
    (patched(OLD, 104, "B", 0x80 | 99), "cannot be read as LAS or LAZ"),
    (patched(written("1.2", 3, 0, False), 131, "d", float("nan")), "every point is NaN"),
]


@pytest.mark.parametrize(("content", "complaint"), FALSE_HEADERS)
def test_a_false_header_is_an_error(content: bytes, complaint: str):
    with pytest.raises(FrameError, match=complaint) as caught:
        parse_las(Path("a.laz"), content)
    assert str(caught.value).startswith("a.laz: ")


def damage(draw: Callable[..., int], content: bytearray) -> None:
    start = min(start_of(content), len(content))
    # damage of the data that locates the points has more effects than of the points
    around = st.integers(max(start - 80, 0), min(start + 120, len(content) - 1))
    content[draw(st.one_of(around, st.integers(0, len(content) - 1)))] = draw(st.sampled_from([0, 1, 127, 128, 255]))
