"""KITTI rows, folders, archives and tracklets: numbers by the devkit's conventions, and errors of damaged ones.

tests/benchmarks/test_benchmarks_run.py has the reference numbers.
"""

from __future__ import annotations

import unicodedata
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from dataset_samples import make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetItem, Losses, Lost
from annotator.formats.frame_names import LabelledFrame
from annotator.formats.kitti_folders import (
    calibration_text,
    read_kitti,
    read_kitti_file,
    read_kitti_folder,
    read_kitti_tracks,
)
from annotator.formats.kitti_rows import (
    derived_box,
    dump_label_line,
    heading_rotation,
    kitti_row,
    read_rows,
    row_truth,
)
from annotator.formats.kitti_tracklets import read_tracklets
from annotator.formats.reading import Angles
from annotator.geometry.oriented_box import box_corners
from annotator.geometry.outline import Sight
from annotator.geometry.projection import pixel_rays
from annotator.types import Camera, Frame, OrientedBox, PointCloud
from annotator.types.errors import FormatError

CAR = "Car 0.25 2 -1.55 548.00 171.33 572.40 194.42 1.48 1.56 3.62 -2.72 0.82 48.22 -1.62"
DONT_CARE = "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10"


def labels_of(found: LabelledFrame) -> list[str]:
    return [truth.label for truth in found.truths]


@pytest.mark.parametrize(("word", "sizes"), [("DontCare", "-1 -1 -1"), ("dontcare", "1.5 1.6 3.9")])
def test_dontcare_rows_and_blank_lines_are_skipped(tmp_path: Path, word: str, sizes: str):
    """In any case, as in the devkit, and whatever stands in the fields of a 3D box."""
    path = tmp_path / "a.txt"
    area = DONT_CARE.replace("DontCare", word).replace("-1 -1 -1 -1000", f"{sizes} -1000")
    path.write_text(f"{area}\n\n{CAR}\n")
    ((name, found),) = read_kitti(tmp_path).items()
    assert (name, labels_of(found), found.flat) == ("a", ["Car"], 0)
    assert [row.label for row in read_kitti_file(path)] == ["DontCare", "Car"]
    tracking = tmp_path / "label_02.txt"
    tracking.write_text(f"0 -1 {area}\n0 7 {CAR}\n")
    assert [(row.frame, row.track, row.is_solid) for row in read_rows(tracking, tracking=True)] == [
        (0, -1, False),
        (0, 7, True),
    ]


@pytest.mark.parametrize(("written", "read"), [("0", 0.0), ("2", None), ("1.00", 1.0)])
def test_levels_of_truncation_in_tracking_files_are_no_fractions(tmp_path: Path, written: str, read: float | None):
    path = tmp_path / "label_02.txt"
    path.write_text(f"0 7 {CAR.replace('0.25', written, 1)}\n")
    (row,) = read_rows(path, tracking=True)
    truth = row_truth(row, None, path, Angles())
    assert truth.attributes.get("truncation") == read


def test_accented_names_keep_the_shift_to_the_colour_camera(tmp_path: Path):
    composed, decomposed = (unicodedata.normalize(form, "Bü") for form in ("NFC", "NFD"))
    for name, text in (
        (f"label_2/{composed}.txt", CAR), (f"label_02/{decomposed}.txt", f"3 1 {CAR}"),
        (f"calib/{decomposed}.txt", "P2: 100 0 50 6 0 100 40 0 0 0 1 0\n"),
    ):  # fmt: skip
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    for frames, name in ((read_kitti(tmp_path), composed), (read_kitti_tracks(tmp_path), f"{composed}/000003")):
        assert list(frames) == [name]
        T = frames[name].T_camera(frame)
        assert T is not None
        np.testing.assert_allclose(T.translation, [0.06, 0, 0])


def test_a_name_in_both_unicode_forms_is_refused(tmp_path: Path):
    for form in ("NFC", "NFD"):
        (tmp_path / f"{unicodedata.normalize(form, 'Bü')}.txt").write_text(CAR)
    with pytest.raises(FormatError, match=r"has two files called Bü\.txt; keep one"):
        read_kitti(tmp_path)


LABEL = "Car 0.00 0 -1.57 100.00 120.00 200.00 180.00 1.50 1.60 4.00 0.50 1.60 20.00 -1.55"
RESULT = LABEL + " 0.875"


def folder_of(path: Path, files: dict[str, str]) -> Path:
    path.mkdir()
    for name, text in files.items():
        (path / name).write_text(text)
    return path


def archive_of(path: Path, files: dict[str, str]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


FILES = {"000001.txt": f"{RESULT}\n\n{RESULT}\r\n", "000000.txt": "", "readme.md": "no labels"}


@pytest.mark.parametrize("make", [folder_of, archive_of])
def test_a_folder_and_its_archive_give_the_same_rows(tmp_path: Path, make) -> None:
    found = read_kitti_folder(make(tmp_path / "found", FILES), scored=True)
    assert {key: len(rows) for key, rows in found.items()} == {"000000": 0, "000001": 2}
    row = found["000001"][0]
    numbers = (row.occluded, row.left, row.length, row.rotation_y, row.score)
    assert (row.label, *numbers) == ("Car", 0, 100, 4, -1.55, 0.875)


def changed(**fields: str) -> str:
    """The row with some fields replaced, given by their number."""
    row = RESULT.split()
    for number, text in fields.items():
        row[int(number[1:])] = text
    return " ".join(row)


BROKEN = [
    pytest.param("Car 1 2 3", "has 15 fields", id="too-few"),
    pytest.param(changed(_5="wide"), "'wide' is not a number", id="text"),
    pytest.param(changed(_2="0.5"), "not a whole number", id="half-occluded"),
    pytest.param(changed(_8="-1.5"), "must be positive", id="negative-size"),
]


@pytest.mark.parametrize(("row", "problem"), BROKEN)
def test_a_broken_row_is_named(tmp_path: Path, row: str, problem: str) -> None:
    path = folder_of(tmp_path / "found", {"000003.txt": f"{RESULT}\n{row}\n"})
    with pytest.raises(FormatError, match=problem) as caught:
        read_kitti_folder(path, scored=True)
    assert (caught.value.path, caught.value.line) == (path / "000003.txt", 2)
    assert str(caught.value).startswith(f"{path / '000003.txt'}:2: ")


def test_unusable_folders_and_archives_are_errors(tmp_path: Path) -> None:
    (tmp_path / "file.txt").write_text(RESULT)
    (tmp_path / "cut.zip").write_bytes(archive_of(tmp_path / "b.zip", {"1.txt": RESULT * 99}).read_bytes()[:-30])
    archive_of(tmp_path / "empty.zip", {"x.md": ""})
    archive_of(tmp_path / "twice.zip", {"a/1.txt": "", "b/1.txt": ""})
    archive_of(tmp_path / "same.zip", {"a/1.txt": RESULT})
    with zipfile.ZipFile(tmp_path / "same.zip", "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("a/1.txt", RESULT)
    neither = "is neither a folder"
    for name, problem in {
        "file.txt": neither, "cut.zip": neither, "empty.zip": "has no .txt", "twice.zip": "two files called 1.txt",
        "same.zip": "two files called 1.txt",
    }.items():  # fmt: skip
        with pytest.raises(FormatError, match=problem):
            read_kitti_folder(tmp_path / name, scored=True)
    with pytest.raises(FormatError, match=r"has no \.txt file"):
        read_kitti_folder(folder_of(tmp_path / "none", {}), scored=True)


CAMERA = Camera(200, 100, 100.0, 100.0, 99.5, 49.5)


def cube(x: float, z: float, size: float = 1.0) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, z]), heading_rotation(0.0), np.full(3, size))


def test_a_box_behind_the_camera_has_no_2d_box() -> None:
    assert derived_box(CAMERA, cube(0.0, -5.0), None) is None
    around = derived_box(CAMERA, cube(0.0, 0.0), None)
    assert around is not None
    assert around.clipped == (0.0, 0.0, 199.0, 99.0)
    beside = derived_box(CAMERA, cube(-50.0, 5.0), None)
    assert beside is not None and beside.truncated == 1.0
    shifted = derived_box(CAMERA, cube(0.0, 5.5), RigidTransform.from_translation([0.5, 0.0, 0.0]))
    assert shifted is not None and shifted.clipped == pytest.approx((99.5, 39.5, 119.5, 59.5)), "the colour camera"


# Axes of upright boxes in the camera frame, with the length to the right, forward, to the left, towards the camera.
RIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def frame(key: str = "a", T: RigidTransform | None = None, wall_m: float = 20.0, **more: object) -> Frame:
    plane = pixel_rays(CAMERA).reshape(-1, 2)
    xyz = np.column_stack([plane, np.ones(len(plane))]).astype(np.float32) * np.float32(wall_m)
    cloud = PointCloud(xyz, reflectance=np.full(len(xyz), 0.25, np.float32))
    return Frame(key, 0, CAMERA, np.zeros((100, 200, 3), np.uint8), cloud, T_camera_label=T, **more)  # type: ignore[arg-type]


def box(x: float, z: float, R: np.ndarray = RIGHT, size: Sequence[float] = (1.0, 1.0, 1.0)) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, z]), R, np.array(size))


# The near face of a 1 m cube at 5 m extends 10 px to all sides. In the second row, the left edge is that of the far
# face, 99.5 + 100 * 4.48 / 6. The right edge is at 99.5 + 100 * 5.48 / 5 = 209.1: 10.1 of 34.9 px are outside.
GOLDEN = [
    (box(0.0, 5.5), "car 0.00 0 0.00 89.50 39.50 109.50 59.50 1.00 1.00 1.00 0.00 0.50 5.50 0.00"),
    (box(4.98, 5.5), "car 0.29 0 -0.74 174.17 39.50 199.00 59.50 1.00 1.00 1.00 4.98 0.50 5.50 0.00"),
    # 4 m long away from the camera, 2 m wide, 1.5 m high: the near face is at 7 m
    (
        box(0.0, 9.0, Rotation.from_euler("y", -np.pi / 2).as_matrix() @ RIGHT, (4.0, 2.0, 1.5)),
        "car 0.00 0 -1.57 85.21 38.79 113.79 60.21 1.50 2.00 4.00 0.00 0.75 9.00 -1.57",
    ),
]


@pytest.mark.parametrize(("given", "row"), GOLDEN)
def test_rows_equal_those_computed_by_hand(given: OrientedBox, row: str) -> None:
    here = frame()
    made = dump_label_line(kitti_row("car", given, None, here, Sight(here.cloud.xyz_m)))
    assert made == row


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
        make_label(leaning, label="traffic light"),
        make_label(box(0.0, 6.0), label="DontCare"),
        make_label(box(0.0, -6.0), label="car"),
        make_label(box(90.0, 6.0), label="car"),
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
        assert {name: labels_of(found) for name, found in read_kitti(path).items()} == {
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
    labels = [make_label(box(0.0, 5.5), label="car", attributes=each) for each in values]
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
    items = [DatasetItem("room", frame(key), [make_label(box(0.0, 5.5), label="car")]) for key in ("000004", "000009")]
    with pytest.raises(FormatError, match="exists and is not empty"):
        write("kitti", tmp_path / "out", items, classes=("car",), overwrite=True)
    (tmp_path / "out/frames.csv").write_text("id,recording,key,split\n")
    write("kitti", tmp_path / "out", items, classes=("car",), overwrite=True)
    assert (tmp_path / "out/ImageSets/train.txt").read_text() == "000004\n000009\n"


ROW = "Car 0.00 0 0.10 10.00 20.00 30.00 40.00 1.50 1.60 4.00 1.00 1.60 20.00 0.20\n"
ORIGINS = "id,recording,key,split\n000000,room,7,\n"
WRONG_ORIGINS = [
    ("frames.csv", ORIGINS, "does not list the frame 000001"),
    ("frames.csv", f"{ORIGINS}000001,room,7,\n", "the ids 000000 and 000001 both name room/7"),
    ("classes.txt", "traffic_light\n", r"classes\.txt:1: a line must be `WORD CLASS_NAME`"),
]


@pytest.mark.parametrize(("name", "text", "problem"), WRONG_ORIGINS)
def test_files_that_do_not_fit_their_frames_are_errors(tmp_path: Path, name: str, text: str, problem: str) -> None:
    folder = tmp_path / "label_2"
    folder_of(folder, {"000000.txt": ROW, "000001.txt": ""})
    (tmp_path / "frames.csv").write_text("id,raw_drive\n000000,2011\n")  # KITTI subsets have such a file, too
    assert {frame: len(found.truths) for frame, found in read_kitti(folder).items()} == {"000000": 1, "000001": 0}
    (tmp_path / "frames.csv").write_text(f"{ORIGINS}000001,room,8,\n")
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=problem):
        read_kitti(folder)


HEAD = """<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>
<!DOCTYPE boost_serialization>
<boost_serialization signature="serialization::archive" version="9">
<tracklets class_id="0" tracking_level="0" version="0">
<count>2</count>
"""


def xml(**values: object) -> str:
    return "".join(f"<{name}>{value}</{name}>\n" for name, value in values.items())


def pose(tx: float, ty: float, tz: float, rz: float, truncation: int = 0) -> str:
    return xml(tx=tx, ty=ty, tz=tz, rx=0, ry=0, rz=rz, state=2, truncation=truncation)


def tracklet(label: str, hwl: Sequence[float], first: int, *poses: str) -> str:
    sizes = xml(**dict(zip("hwl", hwl, strict=True)))
    return xml(
        item=xml(objectType=label) + sizes + xml(
            first_frame=first, poses=xml(count=len(poses)) + "".join(xml(item=each) for each in poses), finished=1
        )
    )  # fmt: skip


def document(*tracklets: str) -> str:
    return f"{HEAD}{''.join(tracklets)}</tracklets>\n</boost_serialization>\n"


VAN = tracklet("Van", (2.0, 1.8, 4.5), 3, pose(10, 2, -1.7, 0.5), pose(11, 2, -1.7, 0.6, truncation=99))
PEDESTRIAN = tracklet("Pedestrian", (1.7, 0.6, 0.8), 4, pose(5, -3, -1.6, -2), pose(5, -4, -1.6, -2, truncation=2))


def written(folder: Path, text: str) -> Path:
    path = folder / "tracklet_labels.xml"
    path.write_text(text)
    return path


def by_devkit(h: float, w: float, l: float, t: Sequence[float], rz: float) -> np.ndarray:  # noqa: E741
    """The corners as in run_demoTracklets.m: x along l, y along w, z from the bottom, rotated about z, translated."""
    x = np.array([1, 1, -1, -1, 1, 1, -1, -1]) * l / 2
    y = np.array([1, -1, -1, 1, 1, -1, -1, 1]) * w / 2
    z = np.array([0, 0, 0, 0, 1, 1, 1, 1]) * h
    turn = np.array([[np.cos(rz), -np.sin(rz), 0], [np.sin(rz), np.cos(rz), 0], [0, 0, 1]])
    return (turn @ np.stack([x, y, z])).T + t


def test_frames_tracks_and_corners_are_those_of_the_devkit(tmp_path: Path):
    frames = read_tracklets(written(tmp_path, document(VAN, PEDESTRIAN)))
    # the pedestrian is outside the image in frame 5; a truncation of 99 means unknown
    assert {number: [(t.label, t.track_id) for t in truths] for number, truths in frames.items()} == {
        3: [("Van", 0)],
        4: [("Van", 0), ("Pedestrian", 1)],
    }
    for truth, expected in (
        (frames[3][0], by_devkit(2.0, 1.8, 4.5, (10, 2, -1.7), 0.5)),
        (frames[4][1], by_devkit(1.7, 0.6, 0.8, (5, -3, -1.6), -2)),
    ):
        found = box_corners(truth.box)
        distance = np.linalg.norm(found[:, None] - expected, axis=2)
        np.testing.assert_allclose(distance.min(axis=1), 0, atol=1e-12)
        np.testing.assert_allclose(distance.min(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(frames[3][0].box.rotation[:, 0], [np.cos(0.5), np.sin(0.5), 0])
    np.testing.assert_allclose(frames[3][0].box.size_m, [4.5, 1.8, 2.0])


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("<l>4.5</l>", "<l>-4.5</l>", r"object 0: l w h must be positive, not -4\.5"),
        (">Van<", "> <", "object 0 has no objectType"),
        (">3</first", ">-1</first", "first_frame must be a whole number"),
        ("<ry>0</ry>", "<ry>0.2</ry>", "object 0, pose 0 has rx or ry"),
    ],
)
def test_tracklets_that_are_none_are_refused(tmp_path: Path, old: str, new: str, problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        read_tracklets(written(tmp_path, document(VAN.replace(old, new, 1))))
