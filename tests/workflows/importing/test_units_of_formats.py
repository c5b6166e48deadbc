"""In every format, boxes in other units or orders than the format's are refused, and read once the unit is stated."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.cli.main import main
from annotator.formats.reading import AngleUnit
from annotator.project import Project
from annotator.types import OrientedBox
from annotator.types.errors import ConfigError, FormatError, UnitError, UnitKind
from annotator.workflows.checking.dataset_check import check_datasets
from annotator.workflows.importing import (
    BoxFormat,
    Note,
    format_of,
    import_image_boxes,
    import_labels,
    import_proposals,
    read_labels,
)
from annotator.workflows.recorded.own_labels import import_own_labels

Write = Callable[[Path, float], Path]


def put(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def kitti_row(angle: float, size: str = "1.6 2 4") -> str:
    return f"Car 0 0 -10 277 85 328 120 {size} -1 0 15 {angle}\n"


def kitti(folder: Path, angle: float) -> Path:
    put(folder / "label_2/000001.txt", kitti_row(0.05) + "DontCare -1 -1 -10 1 1 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n")
    put(folder / "label_2/000000.txt", kitti_row(angle))
    return folder


def kitti_tracking(folder: Path, angle: float) -> Path:
    put(folder / "label_02/0000.txt", f"0 1 {kitti_row(angle)}1 1 {kitti_row(0.05)}")
    return folder


def axes(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


def sustechpoints(folder: Path, angle: float) -> Path:
    for name, each in (("000000", angle), ("000001", 0.05)):
        psr = {"position": axes(15, 1, 0.8), "scale": axes(4, 2, 1.6), "rotation": axes(0, 0, each)}
        put(folder / f"label/{name}.json", [{"obj_id": "1", "obj_type": "Car", "psr": psr}])
    return folder


def cuboid(*values: float) -> dict[str, Any]:
    return {"object_data": {"cuboid": [{"name": "c", "val": values, "coordinate_system": "lidar"}]}}


def openlabel_of(path: Path, *cuboids: dict[str, Any]) -> Path:
    frames = {str(number): {"objects": {"1": each}} for number, each in enumerate(cuboids)}
    content = {
        "metadata": {"schema_version": "1.0.0"},
        "coordinate_systems": {"lidar": {"type": "sensor", "parent": "", "children": []}},
        "streams": {"lidar": {"type": "lidar"}},
        "objects": {"1": {"name": "car 1", "type": "Car"}},
        "frames": frames,
    }
    return put(path, {"openlabel": content})


def openlabel(folder: Path, angle: float) -> Path:
    places = [(15, 1, 0.8, 0, 0, each, 4, 2, 1.6) for each in (angle, 0.05)]
    return openlabel_of(folder / "a.json", *(cuboid(*map(float, each)) for each in places))


def box_csv(folder: Path, angle: float) -> Path:
    rows = "".join(f"00000{n},Car,15,1,0.8,4,2,1.6,{each}\n" for n, each in enumerate((angle, 0.05)))
    return put(folder / "boxes.csv", f"image,class,cx,cy,cz,l,w,h,yaw\n{rows}")


def labelcloud(folder: Path, angle: float, form: str = "centroid_rel") -> Path:
    for number, each in enumerate((angle, 0.05)):
        size = {"length": 4, "width": 2, "height": 1.6}
        entry = {"name": "Car", "centroid": axes(15, 1, 0.8), "dimensions": size, "rotations": axes(0, 0, each)}
        put(folder / f"labels/00000{number}.json", {"filename": f"00000{number}.pcd", "objects": [entry]})
    put(folder / "labels/_classes.json", {"classes": [], "format": form})
    return folder


WITH_ANGLES = [
    pytest.param(BoxFormat.KITTI, kitti, id="kitti"),
    pytest.param(BoxFormat.KITTI_TRACKING, kitti_tracking, id="kitti-tracking"),
    pytest.param(BoxFormat.SUSTECHPOINTS, sustechpoints, id="sustechpoints"),
    pytest.param(BoxFormat.OPENLABEL, openlabel, id="openlabel"),
    pytest.param(BoxFormat.BOX_CSV, box_csv, id="box-csv"),
    pytest.param(BoxFormat.LABELCLOUD, labelcloud, id="labelcloud"),
]


def boxes(format: BoxFormat, path: Path, angles: AngleUnit | None = None) -> list[OrientedBox]:
    """The boxes in the labels' own frame."""
    labels: Any = read_labels(format, path, angles)
    return [truth.box for name in sorted(labels.frames) for truth in labels.labelled[name].truths]


@pytest.mark.parametrize(("format", "write"), WITH_ANGLES)
def test_degrees_are_refused_and_converted_on_request(tmp_path: Path, format: BoxFormat, write: Write) -> None:
    path = write(tmp_path / "degrees", -90.0)
    with pytest.raises(UnitError, match=r"-90 is no angle in radians.*\b1 of 2 angles other.*--angles") as caught:
        read_labels(format, path)
    assert caught.value.kind is UnitKind.ANGLE
    wanted = boxes(format, write(tmp_path / "radians", -math.pi / 2))[0]
    found = boxes(format, path, AngleUnit.DEGREES)
    np.testing.assert_allclose(found[0].pose, wanted.pose, atol=1e-12)
    # the small angle, too, is in degrees
    off = found[1].rotation.T @ boxes(format, path, AngleUnit.RADIANS)[1].rotation
    assert np.degrees(Rotation.from_matrix(off).magnitude()) == pytest.approx(np.degrees(0.05) - 0.05)


@pytest.mark.parametrize(
    ("form", "angle", "said"),
    [
        ("centroid_rel", 200.0, r'200 is no angle in radians.*"format": "centroid_rel".*write "centroid_abs"'),
        ("centroid_abs", -1.5, r'2 angles other than 0, all within -pi..pi.*write "centroid_rel"'),
    ],
)
def test_angles_that_contradict_labelclouds_classes_are_refused(
    tmp_path: Path, form: str, angle: float, said: str
) -> None:
    with pytest.raises(UnitError, match=said):
        read_labels(BoxFormat.LABELCLOUD, labelcloud(tmp_path, angle, form))


@pytest.mark.parametrize(("angle", "said"), [(1.5, "may be radians or degrees"), (-90.0, "are neither radians in")])
def test_ambiguous_angles_need_the_option(tmp_path: Path, angle: float, said: str) -> None:
    path = labelcloud(tmp_path, angle)
    (path / "labels/_classes.json").unlink()
    with pytest.raises(UnitError, match=f"{said}.*--angles radians or --angles degrees"):
        read_labels(BoxFormat.LABELCLOUD, path)
    for unit in AngleUnit:
        turn = Rotation.from_rotvec([0, 0, angle], degrees=unit is AngleUnit.DEGREES).as_matrix()
        np.testing.assert_allclose(boxes(BoxFormat.LABELCLOUD, path, unit)[0].rotation, turn, atol=1e-12)


def test_a_format_without_angles_refuses_the_option(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nuscenes has no angles; leave out --angles"):
        read_labels(BoxFormat.NUSCENES, tmp_path, AngleUnit.DEGREES)


def results(folder: Path, *rotations: list[float]) -> Path:
    rows = [
        {
            "translation": [15, n, 0.8],
            "size": [2, 4, 1.6],
            "rotation": each,
            "detection_name": "car",
            "detection_score": 0.5,
        }
        for n, each in enumerate(rotations)
    ]
    return put(folder / "results.json", {"meta": {}, "results": {"s": rows}})


W_LAST, W_FIRST = (
    [0.0, 0.0, 0.25881904510252074, 0.9659258262890683],
    [0.9659258262890683, 0.0, 0.0, 0.25881904510252074],
)


def test_quaternions_in_the_other_order_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnitError, match="as w x y z, 2 of 2 boxes are tilted, and as x y z w 0"):
        read_labels(BoxFormat.NUSCENES, results(tmp_path, W_LAST, W_LAST))
    assert len(list(read_labels(BoxFormat.NUSCENES, results(tmp_path, W_FIRST, W_FIRST)).sizes_m)) == 2
    path = openlabel_of(tmp_path / "o" / "a.json", cuboid(15.0, 1.0, 0.8, *W_FIRST, 4.0, 2.0, 1.6))
    with pytest.raises(UnitError, match="as x y z w, 1 of 1 box is tilted, and as w x y z 0"):
        read_labels(BoxFormat.OPENLABEL, path)
    assert check_datasets(path.parent).by_rule == {"quaternion-order": 1}


TILTED = Rotation.random(6, rng=np.random.default_rng(0)).as_quat(scalar_first=True).tolist()


@pytest.mark.parametrize("rotations", [[[0.0, 0.0, 0.0, 1.0]], TILTED], ids=["half a turn", "tilted in both orders"])
def test_quaternions_that_may_be_right_are_read(tmp_path: Path, rotations: list[list[float]]) -> None:
    assert len(list(read_labels(BoxFormat.NUSCENES, results(tmp_path, *rotations)).sizes_m)) == len(rotations)


def test_turned_2d_boxes_are_counted(make_project: Callable[..., Project], generated: Path, tmp_path: Path) -> None:
    project = make_project(generated / "people")
    turned = {"id": 1, "image_id": 1, "category_id": 1, "bbox": [100, 80, 40, 20], "attributes": {"rotation": 90.0}}
    content = {
        "images": [{"id": 1, "file_name": f"{project.frames.of()[0].key}.png", "width": 320, "height": 240}],
        "annotations": [turned],
        "categories": [{"id": 1, "name": "person"}],
    }
    done = import_image_boxes(project, put(tmp_path / "coco.json", content), None)
    assert (done.boxes, done[Note.AROUND]) == ({"person": 1}, 1)


def test_left_handed_axes_are_refused_by_that_word(tmp_path: Path) -> None:
    mirrored = np.diag([1.0, -1.0, 1.0, 1.0])
    entry = {"label": "a", "center": [0, 0, 3], "size": [1, 1, 1], "rotation": mirrored[:3, :3].tolist()}
    with pytest.raises(FormatError, match="left-handed"):
        read_labels(BoxFormat.BOXES, put(tmp_path / "boxes.json", {"0": entry}))
    camera = {"extrinsic": mirrored.ravel().tolist(), "intrinsic": np.eye(3).ravel().tolist()}
    put(tmp_path / "calib/camera/front.json", camera)
    with pytest.raises(FormatError, match=r"front\.json: extrinsic has left-handed axes"):
        read_labels(BoxFormat.SUSTECHPOINTS, sustechpoints(tmp_path, 0.0))


def test_millimetres_are_refused(tmp_path: Path) -> None:
    put(tmp_path / "label_2/000000.txt", kitti_row(0.0, "1600 2000 4000"))
    with pytest.raises(UnitError, match="look like millimetres;") as caught:
        read_labels(BoxFormat.KITTI, tmp_path)
    assert caught.value.kind is UnitKind.LENGTH


FLAT = "person 0 0 -10 9 9 50 80 -1 -1 -1 -1000 -1000 -1000 -10\n"


def test_rows_of_2d_boxes_are_left_out_and_counted(
    make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    project = make_project(generated / "people")
    first, second = (stored.key for stored in project.frames.of()[:2])
    solid = "person 0 0 0 9 9 50 80 1.8 0.4 0.5 0 1 3 0\n"
    put(tmp_path / f"label_2/{first}.txt", FLAT + solid + FLAT)
    put(tmp_path / f"label_2/{second}.txt", FLAT.replace("-1 -1 -1 -1000", "0 0 0 -1000"))
    proposed = import_proposals(project, read_labels(BoxFormat.KITTI, tmp_path), "detector")
    assert (proposed.boxes, proposed[Note.FLAT]) == ({"person": 1}, 3)
    other = make_project(generated / "people")
    done = import_labels(other, read_labels(BoxFormat.KITTI, tmp_path))
    assert (done.frames, done.boxes, done[Note.FLAT]) == (2, {"person": 1}, 3)


def test_exchanged_sizes_are_said_by_every_import(
    make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    """Rows with length width height in place of height width length."""
    project = make_project(generated / "people", classes=("Car",))
    for stored in project.frames.of()[:2]:
        put(tmp_path / f"label_2/{stored.key}.txt", kitti_row(0.3, "4 2 1.6") + FLAT)
    said = "2 of 2 boxes of well-known classes have the usual size of the class only if length and height are exchanged"
    for run in (import_proposals, import_labels):
        assert f"doubtful: {said}" in run(project, read_labels(BoxFormat.KITTI, tmp_path)).text()
        project = make_project(generated / "people", classes=("Car",))


@pytest.mark.shared
def test_labels_beside_a_recording_are_judged_together(
    make_project: Callable[..., Project], shared: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A frame whose only angle may be radians is not labelled, because others show degrees."""
    training = shared / "data/kitti/training"
    keys = sorted(file.stem for file in (training / "label_2").iterdir())[:2]
    for folder, suffix in (("image_2", "png"), ("velodyne", "bin"), ("calib", "txt")):
        (tmp_path / folder).mkdir()
        for key in keys:
            (tmp_path / folder / f"{key}.{suffix}").symlink_to(training / folder / f"{key}.{suffix}")
    put(tmp_path / f"label_2/{keys[0]}.txt", kitti_row(2.0))
    put(tmp_path / f"label_2/{keys[1]}.txt", kitti_row(-90.0))
    project = make_project(tmp_path, classes=["Car"])
    with pytest.raises(UnitError, match=r"-90 is no angle in radians.*1 of 2 angles"):
        import_own_labels(project, project.recordings.all()[0].id)
    assert not project.labels.select()
    put(tmp_path / f"label_2/{keys[1]}.txt", kitti_row(-1.5) + FLAT)
    done = import_own_labels(project, project.recordings.all()[0].id)
    assert (done.boxes, done[Note.FLAT], list(done.of(Note.UNREADABLE))) == ({"Car": 2}, 1, [])
    put(tmp_path / f"label_2/{keys[1]}.txt", kitti_row(-90.0))
    project.close()
    assert main(["add", project.path.name, str(tmp_path), "--projects", str(project.path.parent)]) == 2
    assert f"{tmp_path.name} is in the project, without the labels beside it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("row", "format"),
    [
        ("0 0.5 0.5 0.2 0.2", "yolo"),
        ("0 0.1 0.1 0.9 0.1 0.9 0.9 0.1 0.9", "yolo"),
        # as many fields as a row of KITTI, of SUN RGB-D and of KITTI's tracks
        (f"0 {' 0.25 0.5' * 7}", "yolo"),
        (kitti_row(0.1).replace("Car", "0"), "kitti"),
        (f"0 1 {kitti_row(0.1)}", "kitti-tracking"),
    ],
)
def test_a_row_shows_its_format(tmp_path: Path, row: str, format: str) -> None:
    assert format_of(put(tmp_path / "000000.txt", row)) == format
