"""Point cloud files: files of other tools are read, and headers that declare missing data are errors."""

from __future__ import annotations

import io
import resource
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.pcd_ply import lzf_decompress
from annotator.types.errors import FrameError

XYZ = np.random.default_rng(0).normal(0, 20, (500, 3)).astype(np.float32)
RGB = np.random.default_rng(1).integers(0, 256, (500, 3)).astype(np.uint8)
SHARE = np.random.default_rng(2).random(500).astype(np.float32)


@pytest.mark.parametrize("has_colors", [True, False])
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.ply", {"write_ascii": True}),
        ("a.ply", {}),
        ("a.pcd", {"write_ascii": True}),
        ("a.pcd", {"compressed": True}),
    ],
)
def test_files_written_by_open3d_are_read(tmp_path: Path, name: str, options: dict[str, bool], has_colors: bool):
    import open3d as o3d

    # rounded, so that the compression finds repetitions
    xyz = np.round(XYZ, 1).astype(np.float64)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz))
    if has_colors:
        cloud.colors = o3d.utility.Vector3dVector(RGB / 255.0)
    path = tmp_path / name
    assert o3d.io.write_point_cloud(str(path), cloud, **options)
    read = read_cloud(path)
    np.testing.assert_allclose(read.xyz_m, xyz, atol=1e-5)
    if has_colors:
        np.testing.assert_array_equal(read.rgb, RGB)
    else:
        assert read.rgb is None
    assert read.reflectance is None


def ply(order: str, extra: str = "", before: bytes = b"") -> bytes:
    mark = {"binary_big_endian": ">", "binary_little_endian": "<"}[order]
    rows = np.zeros(len(XYZ), [("x", mark + "f8"), ("y", mark + "f8"), ("z", mark + "f8"), ("i", mark + "u2")])
    rows["x"], rows["y"], rows["z"], rows["i"] = *XYZ.T, np.rint(SHARE * 65535)
    head = f"ply\nformat {order} 1.0\ncomment made by Åsa\n{extra}element vertex {len(XYZ)}\nproperty double x\n"
    head += "property double y\nproperty double z\nproperty ushort Intensity\nelement face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    return head.encode() + before + rows.tobytes() + b"\x03" + bytes(12)


@pytest.mark.parametrize("order", ["binary_big_endian", "binary_little_endian"])
def test_ply_of_either_byte_order_and_with_other_elements_is_read(tmp_path: Path, order: str):
    path = tmp_path / "a.PLY"
    path.write_bytes(ply(order, "element sensor 2\nproperty int8 id\nproperty float32 time\n", bytes(10)))
    read = read_cloud(path)
    np.testing.assert_array_equal(read.xyz_m, XYZ.astype(np.float64))
    np.testing.assert_allclose(read.reflectance, SHARE, atol=1e-5)


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


def pcd(data: str, body: bytes, points: int = len(XYZ), fields: str = "") -> bytes:
    names = fields or "FIELDS x y z _ intensity _\nSIZE 4 4 4 1 1 2\nTYPE F F F U U I\nCOUNT 1 1 1 3 1 2\n"
    return (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n{names}WIDTH {points}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {data}\n"
    ).encode() + body


def pcd_rows() -> np.ndarray:
    rows = np.zeros(len(XYZ), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", 3), ("i", "u1"), ("__", "<i2", 2)])
    rows["x"], rows["y"], rows["z"], rows["i"] = *XYZ.T, np.rint(SHARE * 255)
    return rows


def literal(data: bytes) -> bytes:
    """LZF data without any compression."""
    return b"".join(bytes([len(part) - 1]) + part for part in (data[at : at + 32] for at in range(0, len(data), 32)))


def compressed(data: bytes, promised: int | None = None) -> bytes:
    packed = literal(data)
    return struct.pack("<II", len(packed), len(data) if promised is None else promised) + packed


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_with_padding_and_intensity_is_read(tmp_path: Path, data: str):
    rows = pcd_rows()
    lines = (f"{r['x']:.9g} {r['y']:.9g} {r['z']:.9g} 0 0 0 {r['i']} 0 0" for r in rows)
    columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in rows.dtype.names)
    body = {
        "ascii": "\n".join(lines).encode(),
        "binary": rows.tobytes(),
        "binary_compressed": compressed(columns),
    }[data]
    path = tmp_path / "a.pcd"
    path.write_bytes(pcd(data, body))
    read = read_cloud(path)
    np.testing.assert_allclose(read.xyz_m, XYZ.astype(np.float64), rtol=1e-7)
    np.testing.assert_allclose(read.reflectance, SHARE, atol=0.003)
    assert read.rgb is None


def saved(**arrays: np.ndarray) -> Callable[[Path], object]:
    return lambda path: np.savez_compressed(path, **arrays)


ARRAYS = [
    pytest.param("a.npy", lambda p: np.save(p, XYZ), None, None, id="xyz"),
    pytest.param("a.npy", lambda p: np.save(p, np.asfortranarray(np.c_[XYZ, SHARE])), None, SHARE, id="reflectance"),
    pytest.param("a.npy", lambda p: np.save(p, np.c_[XYZ, RGB / 255]), RGB, None, id="colours-0-to-1"),
    pytest.param("a.npy", lambda p: np.save(p, np.c_[XYZ, RGB]), RGB, None, id="colours-0-to-255"),
    pytest.param("a.npz", saved(points=XYZ, colors=RGB), RGB, None, id="npz"),
    pytest.param("a.npz", saved(arr_0=np.c_[XYZ, SHARE], other=SHARE), None, SHARE, id="npz-unnamed"),
    pytest.param(
        "a.npy",
        lambda p: np.save(p, np.rec.fromarrays([*XYZ.T, SHARE], names=["X", "Y", "Z", "intensity"]).view(np.ndarray)),
        None,
        SHARE,
        id="fields",
    ),
]


@pytest.mark.parametrize(("name", "save", "rgb", "reflectance"), ARRAYS)
def test_numpy_arrays_are_read(
    tmp_path: Path, name: str, save: Callable[[Path], object], rgb: np.ndarray | None, reflectance: np.ndarray | None
):
    save(tmp_path / name)
    read = read_cloud(tmp_path / name)
    np.testing.assert_array_equal(read.xyz_m, XYZ.astype(np.float64))
    for found, expected in ((read.rgb, rgb), (read.reflectance, reflectance)):
        if expected is None:
            assert found is None
        else:
            np.testing.assert_array_equal(found, expected)


HUGE = 10**17


def npy_header(shape: tuple[int, ...], descr: object = "<f4") -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": descr, "fortran_order": False, "shape": shape})
    return out.getvalue()


XYZ_FIELDS = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\n"
FALSE_HEADERS = [
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nend_header\n1\n" % HUGE, "declares"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1 1\n", "only lists"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "has no column y z"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "no vertices"),
    ("a.ply", ply("binary_big_endian")[:3000], "declares 500 points"),
    ("a.pcd", pcd("binary", bytes(120), HUGE, XYZ_FIELDS), "declares"),
    ("a.pcd", pcd("ascii", b"1 2 3\n4 5\n7.000 8 9\n", 3, XYZ_FIELDS), "line 12 has 2 values instead of 3"),
    ("a.pcd", pcd("binary_compressed", compressed(bytes(120), HUGE % 2**32), HUGE, XYZ_FIELDS), "declares"),
    ("a.pcd", pcd("binary_compressed", compressed(bytes(120))[:50], 10, XYZ_FIELDS), "compressed bytes but has"),
    ("a.pcd", pcd("binary_compressed", struct.pack("<II", 3, 120) + b"\xe0\xff\x10", 10, XYZ_FIELDS), "before the beg"),
    ("a.pcd", pcd("gzip", b"", 10, XYZ_FIELDS), "encoding 'gzip' is unknown"),
    ("a.pcd", pcd("binary", bytes(12), 1, "FIELDS x y z\nSIZE 4 4\nTYPE F F F\n"), "different lengths"),
    ("a.pcd", b"VERSION 0.7\nFIELDS x\nSIZE 4\nTYPE F\nPOINTS\nDATA binary\n", "has neither POINTS nor"),
    ("a.npy", npy_header((HUGE, 3)) + bytes(36), "its array is damaged"),
    ("a.npy", npy_header((3, 3)) + bytes(35), "its array is damaged"),
    ("a.npy", npy_header((3, 5)) + bytes(60), r"shape \(3, 5\)"),
    ("a.npy", b"\x93NUMPY\x01\x00\xff\xff{", "its array is damaged"),
    ("a.npz", b"PK\x03\x04 no archive", "archive cannot be read"),
    ("a.pcd", b"", "the file is empty"),
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
    np.savez(tmp_path / "a.npz", points=XYZ, colors=RGB[:-1])
    with pytest.raises(FrameError, match="for 500 points"):
        read_cloud(tmp_path / "a.npz")


@settings(deadline=None)
@given(st.lists(st.one_of(st.binary(min_size=1, max_size=32), st.tuples(st.integers(1, 400), st.integers(3, 264)))))
def test_lzf_data_is_decompressed(steps: list[bytes | tuple[int, int]]):
    plain, packed = bytearray(), bytearray()
    for step in steps:
        if isinstance(step, bytes):
            plain += step
            packed += bytes([len(step) - 1]) + step
        elif step[0] <= len(plain):
            distance, length = step
            for _ in range(length):
                plain.append(plain[-distance])
            high, low = divmod(distance - 1, 256)
            short = length - 2
            packed += bytes([short << 5 | high, low] if short < 7 else [7 << 5 | high, short - 7, low])
    assert lzf_decompress(bytes(packed), len(plain)) == bytes(plain)


def test_a_point_with_a_signalling_nan_is_skipped(tmp_path: Path):
    rows = np.array([[1, 2, 3], [4, 5, 6]], "<f4").tobytes()
    (tmp_path / "a.pcd").write_bytes(pcd("binary", rows[:8] + b"\x01\x00\xa0\x7f" + rows[12:], 2, XYZ_FIELDS))
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").xyz_m, [[4, 5, 6]])


TEXT_CLOUDS = {
    ".ply": "ply\nformat ascii 1.0\nelement vertex 2\n"
    "property float x\nproperty float y\nproperty float z\nend_header\n",
    ".pcd": "# .PCD v0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n",
}


@pytest.mark.parametrize("suffix", TEXT_CLOUDS)
def test_text_with_a_mark_and_line_ends_of_windows_is_read_and_a_decimal_comma_named(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"
    text = TEXT_CLOUDS[suffix] + "1 2 3\n4.5 5 6\n"
    path.write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    np.testing.assert_array_equal(read_cloud(path).xyz_m, [[1, 2, 3], [4.5, 5, 6]])
    path.write_text(text.replace("4.5", "4,5"))
    with pytest.raises(FrameError, match="'4,5' has a decimal comma; write a point"):
        read_cloud(path)


@pytest.mark.parametrize("rows", [1, 3])
def test_a_number_with_an_underscore_is_refused(tmp_path: Path, rows: int):
    path = tmp_path / "a.ply"
    path.write_text(TEXT_CLOUDS[".ply"].replace("vertex 2", f"vertex {rows}") + "1 2 3\n" * (rows - 1) + "1 1_000 3\n")
    with pytest.raises(FrameError, match=f"point {rows}: '1_000' is not a number"):
        read_cloud(path)


def test_an_archive_that_unpacks_to_too_many_bytes_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    np.savez_compressed(tmp_path / "a.npz", points=np.ones((100_000, 3)))
    assert (tmp_path / "a.npz").stat().st_size < 10_000
    assert len(read_cloud(tmp_path / "a.npz").xyz_m) == 100_000
    monkeypatch.setenv("ANNOTATOR_FRAME_MEMORY", "10")
    with pytest.raises(FrameError, match=r"too large: 100000 points take about 13 MiB .* limit is 10 MiB"):
        read_cloud(tmp_path / "a.npz")
