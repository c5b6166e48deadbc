"""Colours of points are the same three in every format, type of number, depth and encoding."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from cloud_samples import npy, pcd, ply, ros_cloud

from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.recordings.clouds.columns import RawCloud, from_columns
from annotator.recordings.ros.messages import cloud_of as read_message
from annotator.types.errors import FrameError

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
