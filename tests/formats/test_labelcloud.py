"""labelCloud: its conventions, round trips without drift, and an error if the unit of the angles is unclear."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import assert_same_box, make_box, make_item, make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import XYZ
from annotator.formats.frame_names import of_recording
from annotator.formats.labelcloud import read_labelcloud, vertices_object
from annotator.geometry.transforms import level_pose
from annotator.types import OrientedBox
from annotator.types.errors import FormatError

# The up direction of a camera that looks down by 30 degrees.
LOOKS_DOWN = (0.0, -np.sqrt(0.75), -0.5)
UPRIGHT_X = make_box((1.0, 2.0, 3.0), (0.0, -np.pi / 2, 0.0), (4.0, 2.0, 1.5))


def objects(out: Path, name: str = "rec-000003") -> list[dict[str, Any]]:
    content: list[dict[str, Any]] = json.loads((out / "labels" / f"{name}.json").read_text())["objects"]
    return content


def test_a_project_equals_the_one_by_hand(tmp_path: Path) -> None:
    """With a level camera, the centre is (z, -x, -y). The box's length points to the camera's left, -x."""
    box = make_box((0.5, 0.25, 2.0), (0.0, 0.0, 0.0), (4.0, 2.0, 1.5))
    turned = OrientedBox.from_parts(
        box.center_m, np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]), box.size_m
    )
    write("labelcloud", tmp_path / "out", [make_item([make_label(turned)])], classes=("hand", "Büro"))
    label = json.loads((tmp_path / "out/labels/rec-000003.json").read_text())
    assert label == {
        "folder": "pointclouds",
        "filename": "rec-000003.ply",
        "path": "pointclouds/rec-000003.ply",
        "objects": [
            {
                "name": "hand",
                "centroid": {"x": 2.0, "y": -0.5, "z": -0.25},
                "dimensions": {"length": 4.0, "width": 2.0, "height": 1.5},
                "rotations": {"x": 0.0, "y": 0.0, "z": round(np.pi / 2, 8)},
            }
        ],
    }
    assert list(label["objects"][0]["rotations"]) == ["x", "y", "z"], "labelCloud reads them in the order of the file"
    classes = json.loads((tmp_path / "out/labels/_classes.json").read_text())
    assert (classes["format"], classes["type"], classes["default"]) == ("centroid_rel", "object_detection", 0)
    assert [(each["id"], each["name"], len(each["color"])) for each in classes["classes"]] == [
        (0, "hand", 7),
        (1, "Büro", 7),
    ]


def test_vertices_are_in_labelclouds_order() -> None:
    """A quarter turn to the left about z: the length is along y."""
    entry = vertices_object("a", make_box((0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2), (4.0, 2.0, 1.0)))
    low = [[1, -2, -0.5], [-1, -2, -0.5], [-1, 2, -0.5], [1, 2, -0.5]]
    np.testing.assert_allclose(np.array(entry["vertices"]), low + [[x, y, 0.5] for x, y, _ in low], atol=1e-8)


def test_clouds_of_a_tilted_camera_are_upright(tmp_path: Path) -> None:
    """A point directly below the camera is at -z in the cloud; the calibration maps back to the camera."""
    item = make_item([make_label(UPRIGHT_X)], up=LOOKS_DOWN)
    T = level_pose(item.frame.up)
    np.testing.assert_allclose(T.apply(-np.array(LOOKS_DOWN)), [0, 0, -1], atol=1e-12)
    # ahead is the horizontal part of the viewing direction
    np.testing.assert_allclose(T.apply([0.0, 0.0, 1.0]), [np.sqrt(0.75), 0, -0.5], atol=1e-12)
    write("labelcloud", tmp_path / "out", [item])
    data = (tmp_path / "out/pointclouds/rec-000003.ply").read_bytes()
    rows = np.frombuffer(data[data.index(b"end_header\n") + 11 :], [(n, "<f4") for n in XYZ] + [("rgb", "u1", 3)])
    points = np.stack([rows[name] for name in XYZ], axis=1)
    np.testing.assert_allclose(points, T.apply(item.frame.cloud.xyz_m), atol=1e-6)
    (frame,) = read_labelcloud(tmp_path / "out").values()
    assert isinstance(frame.pose, RigidTransform)
    assert_same_box(frame.truths[0].box.transformed(frame.pose), UPRIGHT_X, 1e-7)


def entry(x: float, y: float, z: float) -> dict[str, Any]:
    return {
        "name": "cart",
        "centroid": {"x": 1, "y": 2, "z": 3},
        "dimensions": {"length": 3, "width": 2, "height": 1},
        "rotations": {"x": x, "y": y, "z": z},
    }


def foreign(tmp_path: Path, form: str | None, *entries: dict[str, Any]) -> Path:
    labels = tmp_path / "labels"
    labels.mkdir()
    for number, each in enumerate(entries):
        (labels / f"00000{number}.json").write_text(json.dumps({"path": "../../etc/passwd", "objects": [each]}))
    if form is not None:
        classes = {"classes": [], "default": 0, "type": "object_detection", "format": form}
        (labels / "_classes.json").write_text(json.dumps(classes))
    return tmp_path


@pytest.mark.parametrize(
    ("form", "angles", "degrees"),
    [
        ("centroid_abs", [(0.5, 0, 0)], True),
        (None, [(0, 0, 0.5), (0, 0, 270)], True),
        (None, [(0, 0, 0.5), (0, 0, -0.5)], False),
    ],
)
def test_the_unit_of_the_angles_is_detected(
    tmp_path: Path, form: str | None, angles: list[tuple[float, float, float]], degrees: bool
) -> None:
    found = read_labelcloud(foreign(tmp_path, form, *(entry(*each) for each in angles)))
    for number, each in enumerate(angles):
        (truth,) = found[f"00000{number}"].truths
        want = Rotation.from_euler("ZYX", each[::-1], degrees=degrees)
        assert truth.label == "cart" and found[f"00000{number}"].pose is of_recording
        np.testing.assert_allclose(truth.box.rotation, want.as_matrix(), atol=1e-12)


SKEW = {
    "name": "a",
    "vertices": [[0, 0, 0], [0, 1, 0], [1, 1, 0], [1, 0, 0], [0, 0, 1], [0, 1, 1], [1, 1, 1], [1, 0, 2]],
}
MIRRORED = {"name": "a", "vertices": [[x, y, z] for z in (0, 1) for y, x in ((0, 0), (0, 1), (1, 1), (1, 0))]}


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ([SKEW], r"000000\.json: objects\.0: the vertices lie up to .* off the corners of a box"),
        ([MIRRORED], r"objects\.0: the vertices are not in labelCloud's order"),
        ([{"name": "a"}], r"objects\.0: .*a box needs centroid, dimensions and rotations, or vertices"),
    ],
)
def test_errors_of_invalid_labels_name_the_place(tmp_path: Path, entries: list[dict[str, Any]], problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        read_labelcloud(foreign(tmp_path, None, *entries))


def test_a_damaged_calibration_is_an_error(tmp_path: Path) -> None:
    (foreign(tmp_path, None, entry(0, 0, 0)) / "calib").mkdir()
    (tmp_path / "calib/000000.txt").write_text("R0_rect: 1 0 0 0 1 0 0 0 1\n")
    with pytest.raises(FormatError, match=r"calib/000000\.txt: has no P2 and no Tr_velo_to_cam"):
        read_labelcloud(tmp_path)
