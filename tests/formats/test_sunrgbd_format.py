"""Writing SUN RGB-D: the conventions by hand, round trips, and errors of damaged files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from dataset_samples import make_label, write
from scipy.io import loadmat, savemat
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats import sunrgbd as sunrgbd_meta
from annotator.formats.dataset_writing import DatasetItem, Losses, Lost
from annotator.formats.sunrgbd import (
    META,
    calibration_text,
    dump_label_row,
    dump_meta,
    meta_frame,
    read_extracted_folder,
    read_meta,
    upright_frame,
)
from annotator.geometry.oriented_box import box_corners
from annotator.recordings.sunrgbd import read_extracted_calibration
from annotator.types import Box2D, Camera, Frame, OrientedBox, PointCloud
from annotator.types.errors import FormatError

CAMERA = Camera(40, 30, 50.0, 50.0, 19.5, 14.5)
DOWN_30 = Rotation.from_euler("x", 30, degrees=True)
FLAT = Box2D("bed", 0.0, 4.0, 10.0, 24.0)


def read_pose(file: Path) -> RigidTransform:
    return read_extracted_calibration(file).T_camera_upright


def frame(key: str, up: np.ndarray | None = None, **more: object) -> Frame:
    xyz = np.array([[0.0, 0.0, 2.0], [0.5, -0.25, 2.5]], np.float32)
    cloud = PointCloud(xyz, reflectance=np.zeros(2, np.float32))
    rgb = np.full((30, 40, 3), (51, 102, 255), np.uint8)
    return Frame(key, 0, CAMERA, rgb, cloud, up=up, **more)  # type: ignore[arg-type]


def test_a_row_equals_the_one_by_hand() -> None:
    """1.2 m long along +y (away from the camera), 0.8 m wide, 0.5 m high; pixels count from 1."""
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    box = OrientedBox.from_parts(np.array([0.1, 2.0, -0.5]), R, np.array([1.2, 0.8, 0.5]))
    numbers = "1.000000 5.000000 10.000000 20.000000 0.100000 2.000000 -0.500000 0.400000 0.600000 0.250000"
    assert dump_label_row("bed", box, FLAT) == f"bed {numbers} 0.000000000 1.000000000"


def test_the_calibration_equals_the_one_by_hand() -> None:
    """A camera that looks down by 30 degrees: a point on its axis is ahead and below."""
    up = DOWN_30.apply([0.0, -1.0, 0.0])
    np.testing.assert_allclose(up, [0, -np.sqrt(0.75), -0.5])
    T = upright_frame(frame("a", up))
    np.testing.assert_allclose(T.inv().apply([0.0, 0.0, 2.0]), [0, np.sqrt(3), -1], atol=1e-12)
    tilt, K = (np.array(line.split(), float) for line in calibration_text(CAMERA, T).splitlines())
    np.testing.assert_array_equal(K, [50, 0, 0, 0, 50, 0, 20.5, 15.5, 1])
    # Rtilt, column by column, takes [X, Z, -Y]
    np.testing.assert_allclose(tilt.reshape(3, 3).T @ [0, 2, 0], [0, np.sqrt(3), -1], atol=1e-11)
    level = upright_frame(frame("a"))
    np.testing.assert_allclose(level.apply([1.0, 2.0, 3.0]), [1, -3, 2], atol=1e-12)


def test_the_original_table_is_read(tmp_path: Path) -> None:
    """Its frames are named by paths, sizes are in any order, and `orientation` gives the direction an object faces."""
    fields = ("basis", "coeffs", "centroid", "classname", "sequenceName", "orientation", "label")
    bed = np.empty((1, 1), [(name, object) for name in fields])
    basis, coeffs = np.eye(3), np.array([[-0.4, 0.6, 0.25]])
    bed[0, 0] = (basis, coeffs, np.array([[1.0, 2, 3]]), "bed", "x", np.array([[-1.0, 0.01, 0]]), 1.0)
    row = list(meta_frame("SUNRGBD/kv2/align/1", ("d", "i"), CAMERA, upright_frame(frame("a")), []))
    savemat(tmp_path / META, dump_meta([(*row[:-1], bed)]))
    ((name, found),) = read_meta(tmp_path / META).items()
    assert name == "kv2__align__1"
    (truth,) = found.truths
    np.testing.assert_allclose(truth.box.size_m, [0.8, 1.2, 0.5])
    np.testing.assert_allclose(truth.box.rotation, [[-1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)


def test_errors_of_the_original_table_name_the_object(tmp_path: Path) -> None:
    def row(**fields: object) -> np.ndarray:
        made = np.empty((1, 1), [(name, object) for name in fields])
        made[0, 0] = tuple(fields.values())
        return made

    for tilt, basis, sizes, problem in (
        (np.ones((3, 3)), np.eye(3), np.ones(3), "frame 1, Rtilt is not a rotation"),
        (np.eye(3), np.ones((3, 3)), np.ones(3), "frame 1, object 1, basis is not a rotation"),
        (np.eye(3), np.eye(3), np.zeros(3), "frame 1, object 1: box sizes must be positive"),
    ):
        bed = row(basis=basis, coeffs=sizes, centroid=np.ones(3), classname="bed")
        savemat(tmp_path / META, {"SUNRGBDMeta": row(sequenceName="a/b", Rtilt=tilt, groundtruth3DBB=bed)})
        with pytest.raises(FormatError, match=problem):
            read_meta(tmp_path / META)


def assert_corners_as_in_the_toolbox(out: Path, expected: Sequence[OrientedBox]) -> None:
    """Checks the last objects of frame 1: field names, and corners computed as in SUNRGBDtoolbox."""
    frames = loadmat(out / META, squeeze_me=True, struct_as_record=False)["SUNRGBDMeta"]
    assert list(frames[0]._fieldnames) == list(sunrgbd_meta.FRAME_FIELDS)
    assert (frames[0].sequenceName, frames[0].rgbname) == ("room/x", "000001.jpg")
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    for each, box in zip(frames[0].groundtruth3DBB[-len(expected) :], expected, strict=True):
        found = each.centroid + signs * np.abs(each.coeffs) @ each.basis
        ours = box_corners(box)
        gaps = np.linalg.norm(found[:, None] - ours, axis=2)
        assert (each.classname, np.linalg.det(each.basis)) == ("bed", pytest.approx(1.0))
        assert gaps.min(axis=0).max() < 1e-9


def test_a_folder_reads_back_and_its_losses_are_counted(tmp_path: Path) -> None:
    up = DOWN_30.apply([0.0, -1.0, 0.0])
    upright = upright_frame(frame("a", up))
    lying = OrientedBox.from_parts(np.array([0.0, 0, 2]), upright.rotation.as_matrix(), np.array([0.4, 0.5, 0.6]))
    leaning = OrientedBox.from_parts(
        np.array([0.0, 0, 2]), np.eye(3) @ Rotation.from_euler("x", -100, degrees=True).as_matrix(), np.ones(3)
    )
    labels = [
        make_label(lying, label="night stand"),
        make_label(leaning, label="bed"),
        make_label(OrientedBox.from_parts(np.array([0.0, 0, -2]), np.eye(3), np.ones(3)), label="bed"),
    ]
    items = [
        DatasetItem("room", frame("x", up), labels, "train"),
        DatasetItem("room", frame("y"), [], "val"),
    ]
    losses, classes, out = Losses(), ("bed", "night stand"), tmp_path / "out"
    assert write("sunrgbd", out, items, losses, classes=classes).counts == {"night stand": 1, "bed": 1}
    once = (Lost.TILT, Lost.OUTSIDE, Lost.NAME, Lost.LEVEL)
    assert {loss.kind: loss.count for loss in losses.report()} == {**dict.fromkeys(once, 1), Lost.REFLECTANCE: 2}
    assert (out / "train_data_idx.txt").read_text() == "1\n"
    assert (out / "val_data_idx.txt").read_text() == "2\n"
    points = loadmat(out / "depth" / "000001.mat")["instance"]
    assert points.dtype == np.float32
    np.testing.assert_allclose(points[0], [0, np.sqrt(3), -1, 0.2, 0.4, 1], atol=1e-6)
    found = read_extracted_folder(out, read_pose)
    assert {name: [t.label for t in each.truths] for name, each in found.items()} == {
        "room/x": ["night stand", "bed"],
        "room/y": [],
    }
    found = read_meta(out / META)
    first = found["room/x"]
    assert list(found) == ["room/x", "room/y"] and found["room/y"].truths == []
    assert isinstance(first.pose, RigidTransform)
    assert_corners_as_in_the_toolbox(out, [leaning.transformed(upright.inv())])
    np.testing.assert_allclose(first.truths[1].box.transformed(first.pose).rotation, leaning.rotation, atol=1e-9)


ROW = "bed 1 2 30 20 0.4 2.5 -0.3 0.3 0.5 0.4 0.6 0.8\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (ROW + "bed 1 2\n", r"000001\.txt:2: a label row has 13 fields"),
        (ROW.replace("0.3 0.5", "-0.3 0.5"), r"000001\.txt:1: bed: box sizes must be positive"),
        (ROW.replace("0.6 0.8", "0 0"), r"000001\.txt:1: the orientation of 'bed' has length 0"),
    ],
)
def test_broken_rows_are_named_with_their_line(tmp_path: Path, text: str, problem: str) -> None:
    (tmp_path / "label").mkdir()
    (tmp_path / "label" / "000001.txt").write_text(text)
    with pytest.raises(FormatError, match=problem):
        read_extracted_folder(tmp_path, read_pose)
