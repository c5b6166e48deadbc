"""LAS and LAZ: files written by laspy are read; damaged files cause no crash, endless loop or large memory use."""

from __future__ import annotations

import io
import struct
from functools import lru_cache
from pathlib import Path

import laspy
import numpy as np
import pytest

from annotator.recordings.clouds.cloud_file import parse_las, read_cloud

COUNT = 300
RANDOM = np.random.default_rng(0)
XYZ = np.round(RANDOM.normal(0, 20, (COUNT, 3)), 3)
INTENSITY = RANDOM.integers(0, 65536, COUNT).astype(np.uint16)
RGB = RANDOM.integers(0, 256, (COUNT, 3)).astype(np.uint8)
# LAS version -> point formats, with and without colours, and one with more bytes than the format has
FORMATS = [("1.2", 0, 0), ("1.2", 3, 0), ("1.4", 7, 2)]


@lru_cache
def written(version: str, point_format: int, more: int, is_compressed: bool) -> bytes:
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001, 0.001, 0.001], np.array([10.0, 20.0, 0.0])
    for number in range(more):
        header.add_extra_dim(laspy.ExtraBytesParams(f"more{number}", "u1"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
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


def test_withheld_points_8_bit_colours_and_empty_columns_are_handled():
    header = laspy.LasHeader(point_format=2, version="1.2")
    header.scales = [0.001] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = XYZ.T
    cloud.red, cloud.green, cloud.blue = RGB.T
    cloud.withheld = np.arange(COUNT) % 3 == 0
    out = io.BytesIO()
    cloud.write(out)
    read = parse_las(out.getvalue())
    np.testing.assert_allclose(read.xyz_m, XYZ[np.arange(COUNT) % 3 > 0], atol=1e-9)
    np.testing.assert_array_equal(read.rgb, RGB[np.arange(COUNT) % 3 > 0])
    assert read.reflectance is None


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


@pytest.mark.parametrize(("axes", "count", "left"), [("y", 2, COUNT - 2), ("z", COUNT // 50, 0), ("xyz", 150, 150)])
def test_coordinates_at_the_limits_of_their_type_are_no_points(axes: str, count: int, left: int):
    """Few: left out. Many of one axis: saturated. Any number of all three axes: no return."""
    for limit in LIMITS:
        content = saturated(axes, count, limit)
        if left:
            np.testing.assert_allclose(parse_las(content).xyz_m, XYZ[count:], atol=1e-9)
            continue
        with pytest.raises(
            ValueError, match=rf"saturated: {axes} is at the limit of int32 in {count} of {COUNT} points"
        ):
            parse_las(content)


def test_a_crash_of_the_decoder_is_an_error_of_the_file(tmp_path: Path):
    """Found by `scripts/fuzz files`: on these bytes lazrs reads memory that is not its own."""
    sound = written("1.2", 3, 0, True)
    damaged = sound[:2015] + b"\xff" * 2024 + sound[4039:]
    with pytest.raises(ValueError, match="is damaged: its decoder crashed"):
        parse_las(damaged)
    assert len(parse_las(sound).xyz_m) == COUNT


def patched(data: bytes, at: int, code: str, value: int) -> bytes:
    return data[:at] + struct.pack(f"<{code}", value) + data[at + struct.calcsize(f"<{code}") :]


HUGE = 2**32 - 1
OLD, NEW = written("1.2", 3, 0, True), written("1.4", 7, 2, True)
FALSE_HEADERS = [
    (b"LASF" + bytes(300), "position of the points, byte 0"),
    (written("1.2", 3, 0, False)[:-1], "cannot be read as LAS or LAZ"),
    (written("1.2", 3, 0, False)[:-34], "declares 300 points but ends after 299"),
    (patched(written("1.2", 3, 0, False), 107, "I", HUGE), f"{HUGE} points take about"),
    (patched(OLD, 107, "I", 2**25), "33554432 points take about 4096 MiB"),
    (OLD[: len(OLD) // 2], "cannot be read as LAS or LAZ"),
]


@pytest.mark.parametrize(("content", "complaint"), FALSE_HEADERS)
def test_a_false_header_is_an_error(content: bytes, complaint: str):
    with pytest.raises(ValueError, match=complaint):
        parse_las(content)
