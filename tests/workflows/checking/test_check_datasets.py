"""`annotator check PATH`: each rule finds its error, with file and line, and nothing else."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import degrees
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.cli.main import main
from annotator.formats.kitti_rows import KittiLabel, derived_box, label_box, observation_angle
from annotator.recordings import open_recording
from annotator.types import Camera
from annotator.types.errors import RecordingError
from annotator.workflows.checking.dataset_check import check_datasets
from annotator.workflows.checking.findings import RULES, Findings, Severity
from annotator.workflows.checking.sources import other_software_dataset, stray_names
from annotator.workflows.importing.report import SizeOrders

WIDTH, HEIGHT, F = 240, 120, 150.0
CAMERA = Camera(WIDTH, HEIGHT, F, F, 119.5, 59.5)
CALIB = (
    f"P2: {F} 0 119.5 0 0 {F} 59.5 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n"
)
KEYS = ("000000", "000001", "000002")
DONT_CARE = "DontCare -1 -1 -10 10 10 20 20 -1 -1 -1 -1000 -1000 -1000 -10"

HOSTILE = ["nan", "1e999", "1e300", "-1e300", "1e9", "-1e9", "1e-300", "0", "-1", "1", "3.5", "x", "\x00", "1e4"]
Found = list[tuple[str, str, int | None]]
Edit = Callable[[Path], object]


def car(x: float, z: float, rotation_y: float = 1.2, length: float = 4.0) -> KittiLabel:
    """A row whose 2D box and alpha are derived from its 3D box."""
    row = KittiLabel("Car", 0.0, 0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.5, 1.6, length, x, 1.5, z, rotation_y)
    alpha = observation_angle(rotation_y, x, z)
    derived = derived_box(CAMERA, label_box(row), None)
    assert derived is not None
    return KittiLabel("Car", derived.truncated, 0, alpha, *derived.clipped, 1.5, 1.6, length, x, 1.5, z, rotation_y)


def line(row: KittiLabel) -> str:
    return " ".join(str(value) for value in vars(row).values() if value is not None)


ROWS = [car(-4.0, 14.0), car(0.0, 20.0, -2.0), car(5.0, 25.0, 0.1)]


def write_kitti(folder: Path, rows: Sequence[KittiLabel], keys: Sequence[str] = ("000000",), tail: str = "") -> Path:
    """Frames with ten points in each car of `ROWS`, points all over the image, and labels that may be others."""
    for name in ("image_2", "velodyne", "calib", "label_2"):
        (folder / name).mkdir(parents=True)
    random = np.random.default_rng(0)
    inside = [label_box(row).T_camera_box.apply(random.uniform(-0.5, 0.5, (10, 3))) for row in ROWS]
    x, y = random.uniform(-1, 1, (2, 400)) * [[0.75], [0.35]]
    xyz = np.concatenate([*inside, np.column_stack([x, y, np.ones(400)]) * 60.0])
    scan = np.column_stack([xyz[:, 2], -xyz[:, 0], -xyz[:, 1], np.zeros(len(xyz))]).astype("<f4")
    image = random.integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    for key in keys:
        cv2.imwrite(str(folder / f"image_2/{key}.png"), image)
        (folder / f"velodyne/{key}.bin").write_bytes(scan.tobytes())
        (folder / f"calib/{key}.txt").write_text(CALIB)
        (folder / f"label_2/{key}.txt").write_text("\n".join([*map(line, rows), tail]))
    return folder


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Three frames without errors: three cars each."""
    return write_kitti(tmp_path / "data", ROWS, KEYS, f"{DONT_CARE}\n")


def found(path: Path) -> Found:
    """Rule, relative file path and line of all findings."""
    report = check_datasets(path)
    return [(f.rule, Path(f.file).relative_to(path).as_posix(), f.line) for f in report.findings]


def rewrite(file: str, old: str | None, new: str) -> Edit:
    def edit(folder: Path) -> None:
        path = folder / file
        path.write_text(new if old is None else path.read_text().replace(old, new, 1))

    return edit


def image_set(name: str, text: str) -> Edit:
    def edit(folder: Path) -> None:
        (folder / "ImageSets").mkdir()
        (folder / f"ImageSets/{name}.txt").write_text(text)

    return edit


def with_row(**changes: float | str) -> Edit:
    """Adds a fourth row to frame 1: a car without points, with some fields changed."""
    return rewrite("label_2/000001.txt", DONT_CARE, line(KittiLabel(**(vars(car(-9.0, 40.0)) | changes))))  # type: ignore[arg-type]


LABELS = "label_2/000001.txt"
EMPTY = ("empty-box", LABELS, 4)
SHEARED = CALIB.replace("0 -1 0 0 0 0 -1 0 1 0 0 0", "0 -1 0 0 0 0.2 -1 0 1 0 0 0")
MANY_WRONG = "\n".join(["Car a", line(ROWS[0]), "Car 1 2 3", "", line(ROWS[1]).replace("Car 0.0 0", "Car nan 0")])

CASES: list[tuple[str, Edit, Found]] = [
    ("nothing", lambda folder: None, []),
    ("image-alone", lambda f: (f / "velodyne/000001.bin").unlink(), [("missing-file", "velodyne/000001.bin", None)]),
    ("cut-image", lambda f: cut(f / "image_2/000001.png"), [("unreadable-file", "image_2/000001.png", None)]),
    ("cut-scan", lambda f: cut(f / "velodyne/000001.bin", 7), [("unreadable-file", "velodyne/000001.bin", None)]),
    ("skewed", rewrite("calib/000001.txt", None, SHEARED), [("unreadable-calibration", "calib/000001.txt", None)]),
    ("no-labels", lambda f: (f / LABELS).unlink(), [("missing-labels", LABELS, None)]),
    ("stray", rewrite("label_2/000009.txt", None, ""), [("stray-file", "label_2/000009.txt", None)]),
    ("stray-calibration", rewrite("calib/000009.txt", None, CALIB), [("stray-file", "calib/000009.txt", None)]),
    ("stale-list", image_set("train", "000000\n000009\n000002\n"), [("stray-file", "ImageSets/train.txt", 2)]),
    ("list-of-frames-elsewhere", image_set("test", "000009\n"), []),
    ("all-wrong-rows", rewrite(LABELS, None, MANY_WRONG), [("broken-label", LABELS, n) for n in (1, 3, 5)]),
    ("no-height", with_row(height=-1.0), [("broken-label", LABELS, 4)]),
    ("empty", with_row(), [EMPTY]),
    ("edges-swapped", with_row(left=90.0, right=10.0), [("broken-label", LABELS, 4), EMPTY]),
    ("truncated", with_row(truncated=7.0), [("field-range", LABELS, 4), EMPTY]),
    ("score", with_row(score=0.9), [("field-range", LABELS, 4), EMPTY]),
    ("behind", with_row(z=-30.0, alpha=-10.0), [("box-behind-camera", LABELS, 4)]),
    ("beside", with_row(x=-90.0, alpha=-10.0), [("box-outside-image", LABELS, 4)]),
    ("2d-box-elsewhere", with_row(left=100.0, right=150.0), [EMPTY, ("image-box-off", LABELS, 4)]),
    ("alpha", with_row(alpha=-1.5), [("alpha-off", LABELS, 4), EMPTY]),
    ("class", with_row(label="car"), [("class-spelling", ".", None), EMPTY]),
    ("long", with_row(length=9.0), [EMPTY, ("odd-size", LABELS, 4)]),
    (
        "tiny",
        with_row(height=0.001),
        [(rule, LABELS, 4) for rule in ("impossible-size", "odd-size", "empty-box", "image-box-off")],
    ),
    ("twice", rewrite(LABELS, DONT_CARE, line(car(-4.1, 14.0))), [("duplicate-label", LABELS, 4)]),
    ("overlap", rewrite(LABELS, DONT_CARE, line(car(-4.5, 14.5))), [("box-overlap", LABELS, 4)]),
]


def cut(path: Path, by: int = 100) -> None:
    path.write_bytes(path.read_bytes()[:-by])


@pytest.mark.parametrize(("edit", "expected"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_each_error_in_a_kitti_folder_is_found_with_file_and_line(kitti: Path, edit: Edit, expected: Found) -> None:
    edit(kitti)
    assert sorted(found(kitti), key=str) == sorted(expected, key=str)


def test_errors_in_all_frames_are_reported_for_the_dataset(kitti: Path) -> None:
    for key in KEYS:
        (kitti / f"calib/{key}.txt").write_text(CALIB.replace(str(F), str(F * 2.2)))
    assert ("boxes-off-image", ".", None) in found(kitti)
    for key in KEYS:
        (kitti / f"calib/{key}.txt").write_text(CALIB.replace(f"{F} 0 119.5", f"{F * 4} 0 478"))
    faults = found(kitti)
    for key in KEYS:
        assert {(rule, f"calib/{key}.txt", None) for rule in ("camera-of-other-size", "impossible-camera")} <= set(
            faults
        )


def test_clouds_in_millimetres_and_outside_the_image_are_found(kitti: Path) -> None:
    for key, (scale, shift) in zip(KEYS, ((1000, 0), (1, -80), (1, 0)), strict=True):
        path = kitti / f"velodyne/{key}.bin"
        scan = np.frombuffer(path.read_bytes(), "<f4").reshape(-1, 4) * [scale, scale, scale, 1] + [shift, 0, 0, 0]
        path.write_bytes(np.append(scan, [[9.0, 0, 0, 0]], axis=0).astype("<f4").tobytes())
    rules = {(rule, file) for rule, file, _ in found(kitti)}
    assert ("cloud-scale", "calib/000000.txt") in rules
    assert ("image-bare", "calib/000001.txt") in rules
    assert ("boxes-off-cloud", ".") in rules
    assert not any(file.endswith("000002.txt") for _, file in rules)


def test_repeated_findings_are_counted_once(tmp_path: Path) -> None:
    findings = Findings()
    for _ in range(3):
        for number in range(30):
            findings.add(RULES["broken-label"], tmp_path, f"fault {number}")
    assert len(findings.all()) == 30


SET_RULES = {"angle-unit", "length-unit", "quaternion-order", "size-order", "mirrored-boxes", "flat-label"}
FLAT_ROW = replace(ROWS[0], height=-1.0, width=-1.0, length=-1.0, x=-1000.0, y=-1000.0, z=-1000.0, rotation_y=-10.0)
Change = Callable[[KittiLabel], KittiLabel]
SETS: dict[str, tuple[Change, dict[str, str]]] = {
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
        {"mirrored-boxes": "2 of 3 boxes .* left and right exchanged"},
    ),
}


@pytest.mark.parametrize(("change", "expected"), SETS.values(), ids=SETS)
def test_what_all_boxes_show_is_one_finding(tmp_path: Path, change: Change, expected: dict[str, str]) -> None:
    report = check_datasets(write_kitti(tmp_path / "data", [change(each) for each in ROWS]))
    said = {f.rule: f.message for f in report.findings if f.rule in SET_RULES}
    assert said.keys() == expected.keys()
    for rule, pattern in expected.items():
        assert report.by_rule[rule] == 1
        assert re.search(pattern, said[rule]), said[rule]


def test_rows_without_3d_boxes_are_a_note_and_no_fault(tmp_path: Path) -> None:
    report = check_datasets(write_kitti(tmp_path / "data", [*ROWS, FLAT_ROW, FLAT_ROW]))
    assert report.by_rule["flat-label"] == 1 and "broken-label" not in report.by_rule
    assert "2 rows have a 2D box and no 3D box" in next(f.message for f in report.findings if f.rule == "flat-label")
    assert report.datasets[0].labels == 3


@pytest.mark.parametrize(
    ("boxes", "said"),
    [
        ([("car", (1.6, 1.9, 4.4))], "1 of 1 box of well-known classes has .* length and height"),
        ([("vehicle.car", (1.9, 4.4, 1.6))], "1 of 1 box .* length and width"),
        ([("Car", (1.9, 4.4, 1.6))] * 2, "2 of 2 boxes .* only if length and width are exchanged"),
        # furniture may be wider than long, and one chair on its side shows nothing
        ([("bed", (1.6, 2.1, 0.95)), ("desk", (0.7, 1.3, 0.75))], None),
        # sizes of no order are an odd size, not another order
        ([("Car", (9.0, 9.0, 9.0))], None),
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


def test_errors_in_a_kitti_drive_are_found(kitti: Path) -> None:
    (kitti / "image_2").rename(kitti / "image_02")
    shutil.copy(kitti / "calib/000000.txt", kitti / "calib.txt")
    rows = [f"{n} {track} {line(row)}" for n in range(3) for track, row in enumerate(ROWS)]
    rows[4] = f"1 0 {line(ROWS[1])}"  # track 0 twice
    rows[8] = f"2 2 {line(car(5.0, 25.0, 0.1 + np.pi))}".replace("Car", "Van")
    rows += [f"7 0 {line(ROWS[0])}", "x", f"2 5 {line(car(0.0, 20.0, 1.1)).replace('Car', 'Truck')}"]
    rows[6] = f"2 0 {line(car(-4.0, 14.0, 2.6))}"
    (kitti / "label_02.txt").write_text("\n".join(rows))
    expected: Found = [
        ("track-twice", "label_02.txt", 5),
        ("heading-jump", "label_02.txt", 7),
        ("track-class", "label_02.txt", 9),
        ("stray-file", "label_02.txt", 10),
        ("broken-label", "label_02.txt", 11),
    ]
    reported = found(kitti)
    assert set(expected) <= set(reported)
    # the changed rows violate more than one rule
    assert {at for _, _, at in reported} <= {5, 7, 9, 10, 11, 12}


def test_generated_recordings_are_without_findings_and_damage_is_found(
    generated: Path, own_copy: Callable[[str], Path]
) -> None:
    assert found(generated / "hands") == []
    people = own_copy("people")
    boxes = json.loads((people / "truth/boxes.json").read_text())
    first, second, *_ = boxes
    boxes["gone"] = boxes[first]
    boxes[second] = [*boxes[second], {"label": "person"}, "person"]
    (people / "truth/boxes.json").write_text(json.dumps(boxes))
    cut(people / "depth/000003.png")
    cv2.imwrite(str(people / "depth/000004.png"), np.ones((9, 9), np.uint16))
    report = check_datasets(people)
    reported = [(f.rule, Path(f.file).name, f.message.split(";")[0]) for f in report.findings]
    assert reported == [
        ("unreadable-file", "000003.png", "the image is damaged or truncated"),
        ("unreadable-file", "000004.png", "the image is 9 x 9 pixels, but the colour image has 320 x 240"),
        ("broken-label", "boxes.json", "000001.3.center: Field required"),
        ("broken-label", "boxes.json", "000001.4: Input should be an object with named fields"),
        ("stray-file", "boxes.json", "there is no frame gone"),
    ]


@pytest.fixture(scope="module")
def exported(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An `rcv` dataset of the generated hands."""
    root = str(tmp_path_factory.mktemp("projects"))
    out = tmp_path_factory.mktemp("out") / "hands"
    assert main(["new", "hands", "--classes", "hand", "--projects", root]) == 0
    assert main(["add", "hands", str(generated / "hands"), "--projects", root]) == 0
    assert main(["export", "hands", str(out), "--projects", root]) == 0
    return out


def test_a_broken_label_without_a_cloud_is_found(generated: Path, tmp_path: Path) -> None:
    root = str(tmp_path / "projects")
    assert main(["new", "hands", "--classes", "hand", "--projects", root]) == 0
    assert main(["add", "hands", str(generated / "hands"), "--projects", root]) == 0
    assert main(["export", "hands", str(tmp_path / "out"), "--format", "labelcloud", "--projects", root]) == 0
    assert found(tmp_path / "out") == []
    (tmp_path / "out/labels/orphan.json").write_text("{")
    findings = check_datasets(tmp_path / "out").findings
    assert [Path(f.file).name for f in findings if f.severity is Severity.ERROR] == ["orphan.json"]


def test_errors_in_rcv_datasets_are_found(exported: Path, tmp_path: Path) -> None:
    assert found(exported) == []
    own = Path(shutil.copytree(exported, tmp_path / "own"))
    ids = sorted(path.stem for path in (own / "labels").iterdir())
    record = json.loads((own / f"labels/{ids[0]}.json").read_text())
    record["objects"] = record["objects"][1:]
    (own / f"labels/{ids[0]}.json").write_text(json.dumps(record))
    (own / "images/other.png").write_bytes(b"")
    assert found(own) == [("manifest-mismatch", "dataset.json", None), ("stray-file", "images/other.png", None)]
    (own / "splits").mkdir()
    (own / "splits/train.txt").write_text(f"{ids[0]}\nother\n")
    (own / "splits/val.txt").write_bytes(b"\xff")
    assert found(own)[2:] == [("stray-file", "splits/train.txt", 2), ("unreadable-file", "splits/val.txt", None)]
    shutil.rmtree(own / "splits")
    other = json.loads((own / f"labels/{ids[1]}.json").read_text())
    other["objects"] += [other["objects"][0] | {"uid": "again"}]
    (own / f"labels/{ids[1]}.json").write_text(json.dumps(other))
    twice = ("duplicate-label", f"labels/{ids[1]}.json", None)
    assert twice in found(own)
    other["objects"][-1]["state"] = "rejected"
    (own / f"labels/{ids[1]}.json").write_text(json.dumps(other))
    assert twice not in found(own)
    record["objects"][0]["size"] = [-1, 1, 1]
    (own / f"labels/{ids[0]}.json").write_text(json.dumps(record))
    (own / f"labels/{ids[1]}.json").unlink()
    cut(own / f"clouds/{ids[2]}.ply")
    assert {each[:2] for each in found(own)} == {
        ("broken-label", f"labels/{ids[0]}.json"),
        ("missing-file", f"labels/{ids[1]}.json"),
        ("missing-labels", f"labels/{ids[1]}.json"),
        ("unreadable-file", f"clouds/{ids[2]}.ply"),
        ("stray-file", "images/other.png"),
    }


def test_all_datasets_in_a_folder_are_checked(kitti: Path, exported: Path) -> None:
    shutil.copytree(exported, kitti.parent / "deep" / "rcv")
    (kitti.parent / "empty" / "color").mkdir(parents=True)
    (kitti.parent / "empty" / "depth").mkdir()
    (kitti.parent / "other" / "samples" / "LIDAR_TOP").mkdir(parents=True)
    (kitti.parent / "other" / "samples" / "LIDAR_TOP" / "a.pcd.bin").write_bytes(b"\0" * 20)
    (kitti.parent / "other" / "v1.0-mini").mkdir()
    (kitti.parent / "other" / "v1.0-mini" / "sample_annotation.json").write_text("[]")
    report = check_datasets(kitti.parent)
    assert [(facts.format, facts.frames) for facts in report.datasets] == [("kitti_object", 3), ("rcv", 5)]
    assert [(f.rule, Path(f.file).name) for f in report.findings] == [
        ("unreadable-dataset", "empty"),
        ("broken-label", "instance.json"),
    ]
    with pytest.raises(RecordingError, match="no known recording format"):
        check_datasets(kitti / "label_2")


BOX = {
    "name": "cup",
    "centroid": {"x": 1.0, "y": 2.0, "z": 3.0},
    "dimensions": {"length": 1.0, "width": 1.0, "height": 1.0},
    "rotations": {"x": 0.0, "y": 0.0, "z": 0.1},
}
COCO = {
    "images": [{"id": 1, "file_name": "a.png", "width": 40, "height": 30}],
    "annotations": [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [1, 2, 3, 4]}],
    "categories": [{"id": 1, "name": "cup"}],
}
CLASSES = {"labels/_classes.json": '{"classes": []}'}
FLAT_BOX = BOX | {"dimensions": {"length": 1.0, "width": 1.0, "height": 0.0}}
NOWHERE = [{"id": n, "image_id": 9, "category_id": 1, "bbox": [1, 2, 3, 4 + n]} for n in (2, 3)]
INSTANCES = "annotations/instances_all.json"
# The format, sound files, the same with several faults, and these: file, line, and beginning of the message.
FOREIGN = [
    (
        "labelCloud labels",
        CLASSES | {"labels/a.json": json.dumps({"objects": [BOX]})},
        {"labels/a.json": json.dumps({"objects": [BOX, FLAT_BOX]}), "labels/b.json": "{"},
        [("b.json", 1, "is not valid JSON"), ("a.json", None, "objects.1.dimensions.height: ")],
    ),
    (
        "COCO boxes",
        {INSTANCES: json.dumps(COCO)},
        {INSTANCES: json.dumps(COCO | {"annotations": COCO["annotations"] + NOWHERE})},
        [("instances_all.json", None, f"annotation {n}: image_id 9 is not in images") for n in (2, 3)],
    ),
    (
        "YOLO boxes",
        {"classes.txt": "cup\n", "labels/a.txt": "0 0.5 0.5 0.1 0.1"},
        {"labels/a.txt": "0 0.5\n7 0.5 0.5 0.1 0.1\n", "labels/b.txt": "x\n", "labels/c.txt": ""},
        [("a.txt", 1, "has 2 fields"), ("a.txt", 2, "class 7 has no name"), ("b.txt", 1, "has 1 fields")],
    ),
]


@pytest.mark.parametrize(("name", "files", "wrong", "faults"), FOREIGN)
def test_labels_of_other_tools_are_read_and_all_their_errors_found(
    tmp_path: Path,
    name: str,
    files: dict[str, str],
    wrong: dict[str, str],
    faults: list[tuple[str, int | None, str]],
) -> None:
    def put(files: dict[str, str]) -> None:
        for file, text in files.items():
            (tmp_path / file).parent.mkdir(exist_ok=True)
            (tmp_path / file).write_text(text)

    put(files)
    report = check_datasets(tmp_path)
    assert [(facts.format, facts.frames, facts.labels) for facts in report.datasets] == [(name, 1, 1)]
    assert [f.rule for f in report.findings] == ["unchecked-dataset"]
    put(wrong)
    reported = [(Path(f.file).name, f.line, f.message) for f in check_datasets(tmp_path).findings]
    for file, line, message in faults:
        assert any(each[:2] == (file, line) and each[2].startswith(message) for each in reported), reported
    assert len(reported) == len(faults)


def test_the_check_command_prints_findings_and_sets_the_exit_code(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with_row()(kitti)
    assert main(["check", str(kitti)]) == 0, "warnings do not change the exit code"
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f"{kitti / LABELS}:4: warning empty-box: the box of this Car holds 0 points"
    assert out[1:] == [f"{kitti}: kitti_object, 3 frames, 10 labels", "0 errors, 1 warning, 0 notes"]
    (kitti / "image_2/000002.png").unlink()
    assert main(["check", str(kitti), "--json"]) == 1
    reported = json.loads(capsys.readouterr().out)
    assert reported["counts"] == {"error": 1, "warning": 1, "note": 0}
    assert {(f["rule"], f["frame"], f["line"]) for f in reported["findings"]} == {
        ("empty-box", "000001", 4),
        ("missing-file", "000002", None),
    }
    assert main(["check", str(tmp_path / "nowhere")]) == 2
    assert "no such file or folder" in capsys.readouterr().err
    monkeypatch.chdir(tmp_path)
    assert main(["new", "data", "--classes", "Car", "--projects", "projects"]) == 0
    assert main(["check", "data"]) == 2
    assert "write ./data or projects/data" in capsys.readouterr().err
    assert main(["check", "./data"]) == 1
    capsys.readouterr()
    assert main(["check", "projects/data"]) == 0
    assert capsys.readouterr().out == "0 warnings; 0 labels checked\n"


def test_the_docs_list_every_rule() -> None:
    text = (Path(__file__).parents[3] / "docs/checks.md").read_text()
    rows = re.findall(r"^\| `([a-z0-9-]+)` \| (\w+) \| .+ \|$", text, re.MULTILINE)
    assert rows == [(rule.id, rule.severity) for rule in RULES.values()]


@pytest.mark.shared
def test_a_rotated_calibration_is_found(shared: Path, tmp_path: Path) -> None:
    real = shared / "data/kitti_drive_0005"
    for name in ("image_02", "velodyne"):
        (tmp_path / name).mkdir()
        for file in sorted((real / name).iterdir())[:4]:
            (tmp_path / name / file.name).symlink_to(file)
    calib = (real / "calib.txt").read_text()
    values = re.search(r"^Tr_velo_to_cam: (.*)$", calib, re.MULTILINE)
    assert values is not None
    Tr = RigidTransform.from_matrix(np.vstack([np.array(values[1].split(), float).reshape(3, 4), [0, 0, 0, 1]]))
    for axis, turn in (("x", "+2 +0 +0"), ("z", "+0 +0 +2")):
        turned = RigidTransform.from_rotation(Rotation.from_euler(axis, -2, degrees=True)) * Tr
        row = " ".join(f"{value:.12e}" for value in turned.as_matrix()[:3].ravel())
        (tmp_path / "calib.txt").write_text(calib.replace(values[1], row))
        (finding,) = check_datasets(tmp_path).findings
        assert (finding.rule, Path(finding.file).name) == ("calibration-off", "calib.txt")
        assert f"turned by {turn} degrees" in finding.message
    (tmp_path / "calib.txt").write_text(calib)
    assert found(tmp_path) == []


@pytest.mark.shared
def test_real_data_has_no_false_findings(shared: Path) -> None:
    report = check_datasets(shared / "data/kitti")
    reported = [(f.rule, Path(f.file).name, f.line) for f in report.findings if f.severity != "note"]
    # a distant, occluded car without points, as mentioned in the data set's README
    assert reported == [("empty-box", "000060.txt", 3)]
    for name in ("sunrgbd/sunrgbd_trainval", "rgbd_open3d_testdata"):
        assert check_datasets(shared / "data" / name).findings == (), name


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.lists(st.tuples(st.integers(1, 14), st.sampled_from(HOSTILE)), min_size=1, max_size=4))
def test_the_check_continues_after_any_label_content(kitti: Path, changes: list[tuple[int, str]]) -> None:
    words = line(ROWS[1]).split()
    for place, word in changes:
        words[place] = word
    (kitti / LABELS).write_text("\n".join([line(ROWS[0]), " ".join(words), line(ROWS[2])]))
    report = check_datasets(kitti)
    assert report.datasets[0].frames == 3
    assert {(finding.file, finding.line) for finding in report.findings} <= {(str(kitti / LABELS), 2)}


def test_lists_of_votenets_folders_are_checked_for_unknown_frames(tmp_path: Path) -> None:
    for file in ("image/000001.jpg", "calib/000001.txt", "calib/000002.txt", "points/000001.npz"):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    (tmp_path / "train_data_idx.txt").write_text("1\n000001\n7\n")
    reported = [(file.name, line, name) for file, line, name in stray_names(open_recording(tmp_path))]
    assert reported == [("000002.txt", None, "000002"), ("train_data_idx.txt", 3, "7")]


@pytest.mark.parametrize(
    ("files", "is_yolo"),
    [
        # the class words of annotator's exports, and another tool's settings
        (["classes.txt", "train_data_idx.txt"], False),
        (["data.yaml"], False),
        (["classes.txt", "labels/classes.txt"], False),
        (["classes.txt", "cam1.txt", "cam1.png"], True),
        (["classes.txt", "labels/cam1.txt"], True),
    ],
)
def test_lists_of_classes_alone_are_no_yolo_dataset(tmp_path: Path, files: list[str], is_yolo: bool) -> None:
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("night_stand night stand\n")
    assert (other_software_dataset(tmp_path) is not None) == is_yolo


def test_openlabel_is_checked_with_and_without_splits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = {
        "metadata": {"schema_version": "1.0.0"},
        "streams": {"cam": {"type": "camera"}},
        "frames": {"0": {}, "1": {}},
    }
    (tmp_path / "out/train").mkdir(parents=True)
    (tmp_path / "out/train/a.json").write_text(json.dumps({"openlabel": document}))
    (tmp_path / "out/train/other.json").write_text("{}")
    whole = f"{tmp_path / 'out/train'}: OpenLABEL documents, 2 frames, 0 labels, so only its files were checked"
    for path in ("out", "out/train"):
        assert main(["check", str(tmp_path / path)]) == 0
        assert whole in capsys.readouterr().out.splitlines()
    cut(tmp_path / "out/train/a.json", 1)
    assert main(["check", str(tmp_path / "out")]) == 1
    assert "1 error" in capsys.readouterr().out
