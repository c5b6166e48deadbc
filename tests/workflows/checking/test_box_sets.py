"""What only all boxes of a dataset show together is one finding, with the number of boxes."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import degrees
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.formats.kitti_rows import KittiLabel, dump_label_line, label_box
from annotator.types import OrientedBox
from annotator.workflows.checking.dataset_check import check_datasets, mirrored
from annotator.workflows.importing.report import SizeOrders

CALIB = (
    "P2: 150 0 119.5 0 0 150 59.5 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
)
SET_RULES = {"angle-unit", "length-unit", "quaternion-order", "size-order", "mirrored-boxes", "flat-label"}


def row(label: str, size: tuple[float, float, float], x: float, z: float, rotation_y: float) -> KittiLabel:
    return KittiLabel(label, 0.0, 0, -10.0, 9.0, 9.0, 50.0, 50.0, *size, x, 1.5, z, rotation_y)


ROWS = [
    row("Car", (1.5, 1.6, 4.0), -4.0, 14.0, 1.2),
    row("Car", (1.5, 1.7, 4.2), 3.0, 20.0, -2.0),
    row("Pedestrian", (1.75, 0.6, 0.8), 6.0, 25.0, 0.1),
]


def kitti(folder: Path, rows: Sequence[KittiLabel]) -> Path:
    """A frame with 20 points in each of `ROWS`, and labels that may differ from these."""
    for name in ("image_2", "velodyne", "calib", "label_2"):
        (folder / name).mkdir(parents=True)
    random = np.random.default_rng(0)
    inside = [label_box(each).T_camera_box.apply(random.uniform(-0.5, 0.5, (20, 3))) for each in ROWS]
    x, y = random.uniform(-1, 1, (2, 400)) * [[0.75], [0.35]]
    xyz = np.concatenate([*inside, np.column_stack([x, y, np.ones(400)]) * 60.0])
    scan = np.column_stack([xyz[:, 2], -xyz[:, 0], -xyz[:, 1], np.zeros(len(xyz))]).astype("<f4")
    cv2.imwrite(str(folder / "image_2/0.png"), random.integers(0, 255, (120, 240, 3)).astype(np.uint8))
    (folder / "velodyne/0.bin").write_bytes(scan.tobytes())
    (folder / "calib/0.txt").write_text(CALIB)
    (folder / "label_2/0.txt").write_text("".join(f"{dump_label_line(each)}\n" for each in rows))
    return folder


FLAT = replace(ROWS[0], height=-1.0, width=-1.0, length=-1.0, x=-1000.0, y=-1000.0, z=-1000.0, rotation_y=-10.0)
Change = Callable[[KittiLabel], KittiLabel]
CASES: dict[str, tuple[Change, dict[str, str]]] = {
    "right": (lambda r: r, {}),
    "in degrees": (
        lambda r: replace(r, rotation_y=degrees(r.rotation_y)),
        {"angle-unit": "2 of 3 angles"},
    ),
    "in millimetres": (
        lambda r: replace(r, height=1000 * r.height, width=1000 * r.width, length=1000 * r.length),
        {"length-unit": "3 of 3 boxes are longer"},
    ),
    "length, width, height": (
        lambda r: replace(r, height=r.length, length=r.height),
        {"size-order": "3 of 3 boxes .* only if length and height are exchanged, such as Car of 1.50 x 1.60 x 4.00 m"},
    ),
    "left-handed": (
        lambda r: replace(r, x=-r.x, rotation_y=np.pi - r.rotation_y),
        {"mirrored-boxes": "3 of 3 boxes .* left and right exchanged"},
    ),
}


@pytest.mark.parametrize(("change", "expected"), CASES.values(), ids=CASES)
def test_what_all_boxes_show_is_one_finding(tmp_path: Path, change: Change, expected: dict[str, str]) -> None:
    report = check_datasets(kitti(tmp_path / "data", [change(each) for each in ROWS]))
    said = {f.rule: f.message for f in report.findings if f.rule in SET_RULES}
    assert said.keys() == expected.keys()
    for rule, pattern in expected.items():
        assert report.by_rule[rule] == 1
        assert re.search(pattern, said[rule]), said[rule]


def test_rows_without_3d_boxes_are_a_note_and_no_fault(tmp_path: Path) -> None:
    report = check_datasets(kitti(tmp_path / "data", [*ROWS, FLAT, FLAT]))
    assert report.by_rule["flat-label"] == 1 and "broken-label" not in report.by_rule
    assert "2 rows have a 2D box and no 3D box" in next(f.message for f in report.findings if f.rule == "flat-label")
    assert report.datasets[0].labels == 3


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        ([("car", (1.6, 1.9, 4.4))], "1 of 1 box of well-known classes has .* length and height"),
        ([("vehicle", (1.6, 1.9, 4.4))], None),
        ([("vehicle.car", (1.9, 4.4, 1.6))], "1 of 1 box .* length and width"),
        ([("Car", (1.9, 4.4, 1.6))] * 2, "2 of 2 boxes .* only if length and width are exchanged"),
        ([("bicycle", (1.7, 0.6, 1.2)), ("bicycle", (1.2, 0.6, 1.7))], None),
        ([("Pedestrian", (1.75, 0.6, 0.8))], "1 of 1 box .* length and height"),
        # furniture may be wider than long, and one chair on its side shows nothing
        ([("bed", (1.6, 2.1, 0.95)), ("desk", (0.7, 1.3, 0.75))], None),
        # as nuScenes has barriers
        ([("barrier", (0.5, 2.53, 0.98))] * 3, None),
        ([("hand", (0.07, 0.1, 0.16))] * 3, None),
        ([("chair", (0.5, 1.1, 0.5))], None),
        # sizes of no order are an odd size, not another order
        ([("Car", (9.0, 9.0, 9.0))], None),
        ([("cat", (0.1, 0.2, 9.0))], None),
        ([], None),
    ],
)
def test_sizes_of_well_known_classes_show_their_order(
    boxes: list[tuple[str, tuple[float, float, float]]], said: str | None
) -> None:
    orders = SizeOrders()
    for label, size in boxes:
        orders.add(label, np.array(size))
    problem = orders.problem()
    assert problem is None if said is None else re.search(said, problem or ""), problem


def test_a_mirrored_box_has_the_mirrored_corners() -> None:
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    box = OrientedBox.from_parts(np.array([1.0, 2.0, 3.0]), turn, np.array([4.0, 2.0, 1.0]))
    inside = box.T_camera_box.apply(np.array([[1.9, -0.9, 0.4]]))[0]
    for axis in range(3):
        flip = np.ones(3)
        flip[axis] = -1
        image = mirrored(box, axis)
        np.testing.assert_allclose(image.center_m, box.center_m * flip)
        local = image.T_camera_box.inv().apply((inside * flip)[None])[0]
        np.testing.assert_allclose(np.abs(local), [1.9, 0.9, 0.4], atol=1e-12)


@pytest.mark.shared
@pytest.mark.parametrize("name", ["kitti", "sunrgbd"])
def test_real_labels_show_nothing(shared: Path, name: str) -> None:
    report = check_datasets(shared / "data" / name)
    assert not SET_RULES & report.by_rule.keys()
    assert sum(each.labels for each in report.datasets) > 0
