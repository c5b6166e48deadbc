"""Writing KITTI: the conventions by hand; tests/benchmarks/test_golden.py has the reference numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from dataset_samples import write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.kitti_objects import KittiRows, calibration_text, each_kitti_frame
from annotator.formats.kitti_rows import (
    derived_box,
    dump_label_line,
    heading_rotation,
    kitti_row,
)
from annotator.formats.losses import Losses, Lost
from annotator.geometry.occlusion import Sight
from annotator.geometry.projection import pixel_rays
from annotator.types import Camera, Frame, Label, OrientedBox, PointCloud, ReviewState, Source
from annotator.types.errors import FormatError

CAMERA = Camera(200, 100, 100.0, 100.0, 99.5, 49.5)


def cube(x: float, z: float, size: float = 1.0) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, z]), heading_rotation(0.0), np.full(3, size))


def test_the_2d_box_is_shifted_with_the_colour_camera() -> None:
    beside = derived_box(CAMERA, cube(0.0, 5.5), RigidTransform.from_translation([0.5, 0.0, 0.0]))
    assert beside is not None
    assert beside.clipped == pytest.approx((99.5, 39.5, 119.5, 59.5))


def test_a_box_behind_the_camera_has_no_2d_box() -> None:
    assert derived_box(CAMERA, cube(0.0, -5.0), None) is None
    around = derived_box(CAMERA, cube(0.0, 0.0), None)
    assert around is not None
    assert around.clipped == (0.0, 0.0, 199.0, 99.0)
    beside = derived_box(CAMERA, cube(-50.0, 5.0), None)
    assert beside is not None and beside.truncated == 1.0


# Axes of upright boxes in the camera frame, with the length to the right, forward, to the left, towards the camera.
RIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
TURNS = [Rotation.from_euler("y", angle).as_matrix() @ RIGHT for angle in (0.0, -math.pi / 2, -math.pi, math.pi / 2)]


def frame(key: str = "a", T: RigidTransform | None = None, wall_m: float = 20.0, **more: object) -> Frame:
    plane = pixel_rays(CAMERA).reshape(-1, 2)
    xyz = np.column_stack([plane, np.ones(len(plane))]).astype(np.float32) * np.float32(wall_m)
    cloud = PointCloud(xyz, reflectance=np.full(len(xyz), 0.25, np.float32))
    return Frame(key, 0, CAMERA, np.zeros((100, 200, 3), np.uint8), cloud, T_camera_label=T, **more)  # type: ignore[arg-type]


def label(box: OrientedBox, name: str = "car", **more: object) -> Label:
    given: dict[str, object] = {"score": None, "source": Source.MANUAL, "state": ReviewState.ACCEPTED, **more}
    return Label("u", name, box, author="me", time_ns=0, **given)  # type: ignore[arg-type]


def box(x: float, z: float, R: np.ndarray = RIGHT, size: Sequence[float] = (1.0, 1.0, 1.0)) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, z]), R, np.array(size))


# The near face of a 1 m cube at 5 m extends 10 px to all sides. In the second row, the left edge is that of the far
# face, 99.5 + 100 * 4.48 / 6. The right edge is at 99.5 + 100 * 5.48 / 5 = 209.1: 10.1 of 34.9 px are outside.
GOLDEN = [
    (box(0.0, 5.5), "car 0.00 0 0.00 89.50 39.50 109.50 59.50 1.00 1.00 1.00 0.00 0.50 5.50 0.00"),
    (box(4.98, 5.5), "car 0.29 0 -0.74 174.17 39.50 199.00 59.50 1.00 1.00 1.00 4.98 0.50 5.50 0.00"),
]


@pytest.mark.parametrize(("given", "row"), GOLDEN)
def test_rows_equal_those_computed_by_hand(given: OrientedBox, row: str) -> None:
    here = frame()
    made = dump_label_line(kitti_row("car", given, None, here, Sight(here.cloud.xyz_m)))
    assert made == row


@pytest.mark.parametrize(("R", "rotation_y"), list(zip(TURNS, ("0.00", "-1.57", "3.14", "1.57"), strict=True)))
def test_rows_have_kittis_headings_and_size_order(R: np.ndarray, rotation_y: str) -> None:
    fields = dump_label_line(kitti_row("car", box(0.0, 9.0, R, (4.0, 2.0, 1.5)), None, frame())).split()
    assert fields[8:11] == ["1.50", "2.00", "4.00"]
    assert fields[14].removeprefix("-" if rotation_y == "3.14" else "+") == rotation_y


@pytest.mark.parametrize(("wall_m", "occluded"), [(20.0, 0), (3.0, 2)])
def test_occlusion_is_measured(wall_m: float, occluded: int) -> None:
    here = frame(wall_m=wall_m)
    assert kitti_row("car", box(0.0, 6.0), None, here, Sight(here.cloud.xyz_m)).occluded == occluded
    assert kitti_row("car", box(0.0, 6.0), None, here, Sight(here.cloud.xyz_m[:0])).occluded == 3


def test_the_losses_of_a_kitti_folder_are_counted(tmp_path: Path) -> None:
    leaning = OrientedBox.from_parts(
        np.array([0.0, 0, 6]), Rotation.from_euler("z", 10, degrees=True).as_matrix() @ RIGHT, np.array([2.0, 1, 1])
    )
    labels = [
        label(leaning, "traffic light"),
        label(box(0.0, 6.0), "DontCare"),
        label(box(0.0, -6.0)),
        label(box(90.0, 6.0)),
    ]
    here = frame("7")
    losses, classes = Losses(), ("traffic light", "car", "DontCare")
    items = [DatasetItem("room", here, labels, "val"), DatasetItem("room", frame("8"), [], "test")]
    counts = write("kitti", tmp_path / "out", items, losses, classes=classes).counts
    assert counts == {"traffic light": 1, "DontCare": 1}
    lost = {loss.kind: loss.count for loss in losses.report()}
    assert (lost[Lost.TILT], lost[Lost.OUTSIDE], lost[Lost.NAME]) == (1, 2, 2)
    sets = {file.stem: file.read_text() for file in (tmp_path / "out" / "ImageSets").iterdir()}
    assert sets == {"val": "000000\n", "test": "000001\n", "trainval": "000000\n"}
    assert (tmp_path / "out" / "training" / "label_2" / "000001.txt").read_text() == ""
    assert (tmp_path / "out" / "frames.csv").read_text().splitlines()[1:] == ["000000,room,7,val", "000001,room,8,test"]
    for path in (tmp_path / "out", tmp_path / "out" / "training" / "label_2"):
        found = dict(each_kitti_frame(path, KittiRows()))
        assert {name: [t.label for t in truths] for name, truths in found.items()} == {
            "room/7": ["traffic light", "DontCare"],
            "room/8": [],
        }


@pytest.mark.parametrize(
    ("name", "written", "lost"),
    [
        ("kitti", ["0.00", "0.50", "0.51", "0.33"], "5 attribute values .* (4 helmet, 1 truncation, rounded)"),
        ("kitti-tracking", ["0", "0", "1", "0"], "7 attribute values .* (4 helmet, 3 truncation, as a level)"),
    ],
)
def test_an_operators_truncation_and_occlusion_replace_the_measured_ones(
    tmp_path: Path, name: str, written: list[str], lost: str
) -> None:
    values = [
        {"truncation": share, "occlusion": number, "helmet": True}
        for number, share in enumerate((0.0, 0.5, 0.51, 0.333))
    ]
    labels = [label(box(0.0, 5.5), attributes=each) for each in values]
    losses = Losses()
    write(name, tmp_path / "out", [DatasetItem("room", frame("7"), labels)], losses, classes=("car",))
    (file,) = (tmp_path / "out/training" / ("label_2" if name == "kitti" else "label_02")).iterdir()
    rows = [row.split()[-15:] for row in file.read_text().splitlines()]
    assert [row[1] for row in rows] == written and [row[2] for row in rows] == ["0", "1", "2", "3"]
    (message,) = [each.message for each in losses.report() if each.kind is Lost.ATTRIBUTE]
    assert message == lost.replace(".*", "cannot be stored in this format")


def test_the_calibration_equals_the_one_by_hand() -> None:
    text = calibration_text(CAMERA, RigidTransform.from_translation([0.5, 0.0, 0.01]))
    rows = {
        name: [float(x) for x in values.split()] for name, _, values in (t.partition(":") for t in text.splitlines())
    }
    assert list(rows) == ["P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    assert rows["P2"] == pytest.approx([100, 0, 99.5, 50.995, 0, 100, 49.5, 0.495, 0, 0, 1, 0.01])
    # a point 5 m ahead, 1 m to the left and 2 m up is at x = -1, y = -2, z = 5
    Tr = np.array(rows["Tr_velo_to_cam"]).reshape(3, 4)
    np.testing.assert_array_equal(Tr @ [5, 1, 2, 1], [-1, -2, 5])


def test_keys_of_six_digits_are_kept_as_ids(tmp_path: Path) -> None:
    (tmp_path / "out/training/label_2").mkdir(parents=True)
    (tmp_path / "out/frames.csv").write_text("id,raw_drive\n000000,2011\n")
    items = [DatasetItem("room", frame(key), [label(box(0.0, 5.5))]) for key in ("000004", "000009")]
    with pytest.raises(FormatError, match="exists and is not empty"):
        write("kitti", tmp_path / "out", items, classes=("car",), overwrite=True)
    (tmp_path / "out/frames.csv").write_text("id,recording,key,split\n")
    write("kitti", tmp_path / "out", items, classes=("car",), overwrite=True)
    assert (tmp_path / "out/ImageSets/train.txt").read_text() == "000004\n000009\n"


ROW = "Car 0.00 0 0.10 10.00 20.00 30.00 40.00 1.50 1.60 4.00 1.00 1.60 20.00 0.20\n"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (ROW + "Car 0 0\n", r"000001\.txt:2: a label row has 15 fields"),
        (ROW.replace("4.00 1.00", "-4 1.00"), r"000001\.txt:1: height width length must be positive"),
        (ROW.replace("20.00 0.20", "nan 0.20"), r"000001\.txt:1: 'nan' is not a finite number"),
    ],
)
def test_broken_labels_are_named_with_their_line(tmp_path: Path, text: str, problem: str) -> None:
    folder = tmp_path / "label_2"
    folder.mkdir()
    (folder / "000000.txt").write_text(ROW)
    (folder / "000001.txt").write_text(text)
    with pytest.raises(FormatError, match=problem):
        dict(each_kitti_frame(tmp_path, KittiRows()))
    (folder / "000001.txt").write_text("")
    (tmp_path / "frames.csv").write_text("id,raw_drive\n000000,2011\n")  # KITTI subsets have such a file, too
    assert {name: len(truths) for name, truths in dict(each_kitti_frame(folder, KittiRows())).items()} == {
        "000000": 1,
        "000001": 0,
    }
    (tmp_path / "frames.csv").write_text("id,recording,key,split\n000000,room,7,\n")
    with pytest.raises(FormatError, match="does not list the frame 000001"):
        dict(each_kitti_frame(folder, KittiRows()))
    (tmp_path / "frames.csv").write_text("id,recording,key,split\n000000,room,7,\n000001,room,7,\n")
    with pytest.raises(FormatError, match="the ids 000000 and 000001 both name room/7"):
        dict(each_kitti_frame(folder, KittiRows()))
    (tmp_path / "frames.csv").write_text("id,recording,key,split\n000000,room,7,\n000001,room,8,\n")
    (tmp_path / "classes.txt").write_text("traffic_light\n")
    with pytest.raises(FormatError, match=r"classes\.txt:1: a line must be `WORD CLASS_NAME`"):
        dict(each_kitti_frame(folder, KittiRows()))


def test_a_tracking_file_gives_frames_and_tracks(tmp_path: Path) -> None:
    file = tmp_path / "label_02.txt"
    file.write_text(
        f"0 5 {ROW}0 -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n3 5 {ROW}4 -1 DontCare" + " -1" * 14
    )
    for path in (tmp_path, file):
        found = dict(each_kitti_frame(path, KittiRows()))
        assert {name: [t.track_id for t in truths] for name, truths in found.items()} == {
            "000000": [5],
            "000003": [5],
            "000004": [],
        }
