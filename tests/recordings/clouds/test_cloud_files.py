"""Point cloud files: files of other tools are read, and headers that declare missing data are errors."""

from __future__ import annotations

import io
import resource
import struct
import sys
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import laspy
import numpy as np
import pytest
from bag_writer import structured
from cloud_samples import lzf, npy, npz, pcd, ply

from annotator.recordings.clouds.cloud_file import parse_las, read_cloud
from annotator.types.errors import FrameError

XYZ = np.random.default_rng(0).normal(0, 20, (500, 3)).astype(np.float32)
RGB = np.random.default_rng(1).integers(0, 256, (500, 3)).astype(np.uint8)
SHARE = np.random.default_rng(2).random(500).astype(np.float32)
SHARES = np.rint(SHARE * 65535).astype(np.uint16)


@pytest.mark.parametrize(("name", "options"), [("a.ply", {}), ("a.pcd", {"compressed": True})])
def test_files_written_by_open3d_are_read(tmp_path: Path, name: str, options: dict[str, bool]):
    import open3d as o3d

    # rounded, so that the compression finds repetitions
    xyz = np.round(XYZ, 1).astype(np.float64)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    cloud.colors = o3d.utility.Vector3dVector(RGB / 255.0)
    path = tmp_path / name
    assert o3d.io.write_point_cloud(str(path), cloud, **options)
    read = read_cloud(path)
    np.testing.assert_allclose(read.xyz_m, xyz, atol=1e-5)
    np.testing.assert_array_equal(read.rgb, RGB)
    assert read.reflectance is None


def vertices(order: str = "<") -> np.ndarray:
    """Points as doubles, with intensities."""
    return structured(dict(zip("xyz", XYZ.T.astype(float), strict=True)) | {"Intensity": SHARES}, order)


def test_text_ply_with_byte_colours_and_another_element_is_read(tmp_path: Path):
    path = tmp_path / "a.ply"
    path.write_text(
        "ply\r\nformat ascii 1.0\r\nelement other 1\r\nproperty int a\r\nelement vertex 2\r\nproperty float x\r\n"
        "property float y\r\nproperty float z\r\nproperty uchar red\r\nproperty uchar green\r\nproperty uchar blue\r\n"
        "end_header\r\n7\r\n1 2 3 0 1 1\r\nnan 5 6 1 0 0\r\n",
        newline="",
    )
    read = read_cloud(path)
    np.testing.assert_array_equal(read.xyz_m, [[1, 2, 3]])
    np.testing.assert_array_equal(read.rgb, [[0, 1, 1]])


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_with_padding_and_intensity_is_read(tmp_path: Path, data: str):
    rows = np.zeros(len(XYZ), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", 3), ("i", "u1"), ("_1", "<i2", 2)])
    rows["x"], rows["y"], rows["z"], rows["i"] = *XYZ.T, np.rint(SHARE * 255)
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(rows, data))
    read = read_cloud(path)
    np.testing.assert_allclose(read.xyz_m, XYZ.astype(np.float64), rtol=1e-7)
    np.testing.assert_allclose(read.reflectance, SHARE, atol=0.003)
    assert read.rgb is None


FIELDS = np.rec.fromarrays([*XYZ.T, SHARE], names=["X", "Y", "Z", "intensity"]).view(np.ndarray)
ARRAYS = [
    ("a.npy", npy(XYZ), None, None), ("a.npy", npy(np.asfortranarray(np.c_[XYZ, SHARE])), None, SHARE),
    ("a.npy", npy(np.c_[XYZ, RGB]), RGB, None), ("a.npy", npy(FIELDS), None, SHARE),
    ("a.npz", npz(arr_0=np.c_[XYZ, SHARE], other=SHARE), None, SHARE),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "rgb", "reflectance"), ARRAYS)
def test_numpy_arrays_are_read(
    tmp_path: Path, name: str, content: bytes, rgb: np.ndarray | None, reflectance: np.ndarray | None
):
    (tmp_path / name).write_bytes(content)
    read = read_cloud(tmp_path / name)
    np.testing.assert_array_equal(read.xyz_m, XYZ.astype(np.float64))
    assert (read.rgb is None, read.reflectance is None) == (rgb is None, reflectance is None)
    assert rgb is None or np.array_equal(read.rgb, rgb)
    assert reflectance is None or np.array_equal(read.reflectance, reflectance)


HUGE = 10**17


def npy_header(shape: tuple[int, ...], descr: object = "<f4") -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": descr, "fortran_order": False, "shape": shape})
    return out.getvalue()


PLAIN = np.zeros(1, [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
FALSE_HEADERS = [
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nend_header\n1\n" % HUGE, "declares"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "has no column y z"),
    ("a.ply", ply(vertices(), "binary_little_endian")[:3000], "declares 500 points"),
    ("a.pcd", pcd(PLAIN, "binary", bytes(120), HUGE), "declares"),
    ("a.pcd", pcd(PLAIN, "ascii", b"1 2 3\n4 5\n7.000 8 9\n", 3), "invalid column index 2 at row 2 with 2 columns"),
    ("a.pcd", pcd(PLAIN, "ascii", b"1 2 3\n4 4,5 6\n", 2), "could not convert string '4,5' to float64 at row 1"),
    ("a.pcd", pcd(PLAIN, "ascii", b"1 1_000 3\n", 1), "could not convert string '1_000'"),
    (
        "a.pcd",
        pcd(PLAIN, "binary_compressed", np.array([124, HUGE % 2**32], "<u4").tobytes() + bytes(124)),
        "its compressed points are damaged",
    ),
    ("a.pcd", pcd(PLAIN, "binary_compressed", lzf(bytes(120))[:50], 10), "compressed bytes but has"),
    ("a.pcd", pcd(PLAIN, "binary_compressed", struct.pack("<II", 3, 120) + b"\xe0\xff\x10", 10), "before the beg"),
    ("a.pcd", b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 1\nDATA binary\n", "the PCD header is damaged"),
    ("a.pcd", pcd(PLAIN, "binary", bytes(120), -1), "the PCD header is damaged .-1 points"),
    ("a.npy", npy_header((HUGE, 3)) + bytes(36), "its array is damaged"),
    ("a.npy", npy_header((3, 5)) + bytes(60), r"shape \(3, 5\)"),
    ("a.npz", b"PK\x03\x04 no archive", "archive cannot be read"),
]


@pytest.mark.parametrize(("name", "content", "complaint"), FALSE_HEADERS)
def test_a_false_header_is_an_error_before_memory_is_allocated(
    tmp_path: Path, name: str, content: bytes, complaint: str
):
    path = tmp_path / name
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(FrameError, match=complaint) as caught:
        read_cloud(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "; " in str(caught.value)
    grown_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert sys.platform != "linux" or grown_kb < 100_000


def test_the_error_of_an_archive_without_points_names_its_arrays(tmp_path: Path):
    np.savez(tmp_path / "a.npz", weights=XYZ)
    with pytest.raises(FrameError, match=r"has no array points or .* \(its arrays: weights\)"):
        read_cloud(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", points=XYZ, cloud=np.array(["other arrays are not read"]))
    assert len(read_cloud(tmp_path / "a.npz").xyz_m) == len(XYZ)
    np.savez(tmp_path / "a.npz", points=XYZ, colors=RGB[:-1])
    with pytest.raises(FrameError, match="for 500 points"):
        read_cloud(tmp_path / "a.npz")


def test_an_archive_that_unpacks_to_too_many_bytes_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    np.savez_compressed(tmp_path / "a.npz", points=np.ones((100_000, 3)))
    assert (tmp_path / "a.npz").stat().st_size < 10_000
    assert len(read_cloud(tmp_path / "a.npz").xyz_m) == 100_000
    monkeypatch.setenv("ANNOTATOR_FRAME_MEMORY", "10")
    with pytest.raises(FrameError, match=r"too large: 100000 points take about 15 MiB .* limit is 10 MiB"):
        read_cloud(tmp_path / "a.npz")


LAS_COUNT = 300
RANDOM = np.random.default_rng(0)
LAS_XYZ = np.round(RANDOM.normal(0, 20, (LAS_COUNT, 3)), 3)
INTENSITY = RANDOM.integers(0, 65536, LAS_COUNT).astype(np.uint16)
LAS_RGB = RANDOM.integers(0, 256, (LAS_COUNT, 3)).astype(np.uint8)
# LAS version -> point formats, with and without colours, and one with more bytes than the format has
FORMATS = [("1.2", 0, 0), ("1.2", 3, 0), ("1.4", 7, 2)]


def las(
    version: str = "1.2",
    point_format: int = 3,
    change: Callable[[laspy.LasData], object] = lambda _: None,
    more: int = 0,
) -> laspy.LasData:
    """A cloud of `LAS_XYZ`, with some more bytes for each point, after a change."""
    header = laspy.LasHeader(point_format=point_format, version=version)
    header.scales, header.offsets = [0.001, 0.001, 0.001], np.array([10.0, 20.0, 0.0])
    for number in range(more):
        header.add_extra_dim(laspy.ExtraBytesParams(f"more{number}", "u1"))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = LAS_XYZ.T
    change(cloud)
    return cloud


def content(cloud: laspy.LasData, is_compressed: bool = False) -> bytes:
    out = io.BytesIO()
    cloud.write(out, do_compress=is_compressed, laz_backend=laspy.LazBackend.Lazrs if is_compressed else None)
    return out.getvalue()


@lru_cache
def written(version: str, point_format: int, more: int, is_compressed: bool) -> bytes:
    def fill(cloud: laspy.LasData) -> None:
        cloud.intensity = INTENSITY
        if "red" in cloud.point_format.dimension_names:
            cloud.red, cloud.green, cloud.blue = LAS_RGB.T.astype(np.uint16) << 8

    return content(las(version, point_format, fill, more), is_compressed)


@pytest.mark.parametrize("suffix", [".las", ".LAZ"])
@pytest.mark.parametrize(("version", "point_format", "more"), FORMATS)
def test_files_written_by_laspy_are_read(tmp_path: Path, version: str, point_format: int, more: int, suffix: str):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(written(version, point_format, more, suffix == ".LAZ"))
    read = read_cloud(path)
    np.testing.assert_allclose(read.xyz_m, LAS_XYZ, atol=1e-9)
    np.testing.assert_allclose(read.reflectance, INTENSITY / 65535, atol=1e-6)
    if point_format in (3, 7, 8):
        np.testing.assert_array_equal(read.rgb, LAS_RGB)
    else:
        assert read.rgb is None


def test_withheld_points_8_bit_colours_and_empty_columns_are_handled():
    def fill(cloud: laspy.LasData) -> None:
        cloud.red, cloud.green, cloud.blue = LAS_RGB.T
        cloud.withheld = np.arange(LAS_COUNT) % 3 == 0

    read = parse_las(content(las(point_format=2, change=fill)))
    np.testing.assert_allclose(read.xyz_m, LAS_XYZ[np.arange(LAS_COUNT) % 3 > 0], atol=1e-9)
    np.testing.assert_array_equal(read.rgb, LAS_RGB[np.arange(LAS_COUNT) % 3 > 0])
    assert read.reflectance is None


LIMITS = (2**31 - 1, -(2**31))


@pytest.mark.parametrize(
    ("axes", "count", "left"), [("y", 2, LAS_COUNT - 2), ("z", LAS_COUNT // 50, 0), ("xyz", 150, 150)]
)
def test_coordinates_at_the_limits_of_their_type_are_no_points(axes: str, count: int, left: int):
    """Few: left out. Many of one axis: saturated. Any number of all three axes: no return."""
    for limit in LIMITS:
        cloud = las()
        for axis in axes:
            cloud[axis.upper()][:count] = limit
        saturated = content(cloud)
        if left:
            np.testing.assert_allclose(parse_las(saturated).xyz_m, LAS_XYZ[count:], atol=1e-9)
            continue
        with pytest.raises(ValueError, match=rf"saturated: {count} of {LAS_COUNT} points are at the limit of int32"):
            parse_las(saturated)


def test_a_crash_of_the_decoder_is_an_error_of_the_file(tmp_path: Path):
    """Found by `scripts/fuzz files`: on these bytes lazrs reads memory that is not its own."""
    sound = written("1.2", 3, 0, True)
    damaged = sound[:2015] + b"\xff" * 2024 + sound[4039:]
    with pytest.raises(ValueError, match="is damaged: its decoder crashed"):
        parse_las(damaged)
    assert len(parse_las(sound).xyz_m) == LAS_COUNT


def patched(data: bytes, at: int, code: str, value: int) -> bytes:
    return data[:at] + struct.pack(f"<{code}", value) + data[at + struct.calcsize(f"<{code}") :]


LAS_HUGE = 2**32 - 1
OLD = written("1.2", 3, 0, True)
FALSE_LAS = [
    (b"LASF" + bytes(300), "position of the points, byte 0"),
    (written("1.2", 3, 0, False)[:-1], "cannot be read as LAS or LAZ"),
    (written("1.2", 3, 0, False)[:-34], "declares 300 points but ends after 299"),
    (patched(written("1.2", 3, 0, False), 107, "I", LAS_HUGE), f"{LAS_HUGE} points take about"),
    (patched(OLD, 107, "I", 2**25), "33554432 points take about 4096 MiB"),
    (OLD[: len(OLD) // 2], "cannot be read as LAS or LAZ"),
]


@pytest.mark.parametrize(("false", "complaint"), FALSE_LAS)
def test_a_false_header_of_las_is_an_error(false: bytes, complaint: str):
    with pytest.raises(ValueError, match=complaint):
        parse_las(false)
