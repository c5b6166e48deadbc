"""OpenLABEL: the standard's conventions, round trips, and other tools' documents and their errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import assert_same_box, make_box, make_item, make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.frame_names import of_recording
from annotator.formats.openlabel import read_openlabel
from annotator.types import BoxKind, Camera, OrientedBox, Suggestion
from annotator.types.errors import FormatError

PLACE_IN_MAP = RigidTransform.from_components([701_378.25, 4_485_513.5, 640.0], Rotation.from_rotvec([1, -0.5, 0.25]))
# 4 x 2 x 1.5 m, 1 m ahead, rotated by 90 degrees about the camera's y axis (right-hand rule: x becomes -z).
TURNED = make_box((0.0, 0.5, 1.0), (0.0, np.pi / 2, 0.0), (4.0, 2.0, 1.5))


def test_a_document_equals_the_one_by_hand(tmp_path: Path) -> None:
    known = {"suggestion": Suggestion("base detector", "f00d"), "box_kind": BoxKind.SILHOUETTE}
    label = make_label(TURNED, score=0.75, track_id=7, expected_iou_loss=0.25, **known)
    write("openlabel", tmp_path / "out", [make_item([label])])
    content = json.loads((tmp_path / "out" / "rec.json").read_text())["openlabel"]
    assert content["metadata"] == {"schema_version": "1.0.0", "name": "rec", "annotator": "annotator 0.1.0"}
    assert content["streams"]["camera"]["stream_properties"]["intrinsics_pinhole"] == {
        "width_px": 6,
        "height_px": 4,
        "camera_matrix": [5.0, 0.0, 2.5, 0.0, 0.0, 5.5, 1.5, 0.0, 0.0, 0.0, 1.0, 0.0],
        "distortion_coeffs": [0.0] * 5,
    }
    # the camera's z is the base's x, its x the base's -y, its y the base's -z
    np.testing.assert_allclose(
        content["coordinate_systems"]["camera"]["pose_wrt_parent"]["quaternion"], [-0.5, 0.5, -0.5, 0.5], atol=1e-12
    )
    frame = content["frames"]["3"]
    assert frame["frame_properties"]["timestamp"] == "1700000000.123456789"
    assert frame["frame_properties"]["streams"]["camera"]["uri"] == "images/rec-000003.png"
    ((uid, dynamic),) = frame["objects"].items()
    (cuboid,) = dynamic["object_data"]["cuboid"]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(cuboid["val"], [0, 0.5, 1, 0, half, 0, half, 4, 2, 1.5], atol=1e-12)
    assert cuboid["coordinate_system"] == "camera"
    assert {num["name"]: num["val"] for num in cuboid["attributes"]["num"]} == {
        "score": 0.75,
        "track_id": 7,
        "expected_iou_loss": 0.25,
    }
    texts = {text["name"]: text["val"] for text in cuboid["attributes"]["text"]}
    assert texts == {
        "state": "accepted",
        "source": "manual",
        "author": "ann",
        "suggested_by": "base detector",
        "suggestion": "accepted",
        "box_kind": "silhouette",
    }
    (pointer,) = content["objects"][uid]["object_data_pointers"].values()
    assert pointer["frame_intervals"] == [{"frame_start": 3, "frame_end": 3}] == content["frame_intervals"]
    assert content["objects"][uid]["type"] == "hand"
    for name in ("images/rec-000003.png", "clouds/rec-000003.ply", "frames.csv"):
        assert (tmp_path / "out" / name).is_file()


def test_the_document_follows_the_schema(tmp_path: Path) -> None:
    """Checks ASAM's schema, and its rules for references and intervals, with the package openlabel-checker."""
    core = pytest.importorskip("openlabel_checker.core", reason="openlabel-checker contains ASAM's schema")
    other = Camera(6, 4, 5.0, 5.0, 2.0, 1.0, (0.1, 0.0, 0.0, 0.01))
    items = [
        make_item([make_label(track_id=1), make_label(track_id=1, uid="u2")], index=0, key="a"),
        make_item([make_label(track_id=1, uid="u3")], index=2, key="c", camera=other, timestamp_ns=None),
        make_item([make_label(track_id=1, uid="u4")], index=5, key="d", T_world_camera=PLACE_IN_MAP),
    ]
    write("openlabel", tmp_path / "out", items)
    result = core.check_file(str(tmp_path / "out" / "rec.json"))
    assert len(result.outcomes) > 5
    assert [issue.message for outcome in result.outcomes for issue in outcome.issues] == []


def foreign(**changes: Any) -> dict[str, Any]:
    """Another tool's document: boxes of 9 values in the LiDAR frame; the vehicle frame connects LiDAR and camera."""
    content: dict[str, Any] = {
        "metadata": {"schema_version": "1.0.0"},
        "coordinate_systems": {
            "vehicle": {"type": "local", "parent": "", "children": ["lidar", "cam"]},
            "lidar": {
                "type": "sensor", "parent": "vehicle",
                "pose_wrt_parent": {"euler_angles": [np.pi / 2, 0, 0], "translation": [1, 0, 2]},
            },
            "cam": {
                "type": "sensor", "parent": "vehicle",
                "pose_wrt_parent": {"matrix4x4": [0, 0, 1, 3, -1, 0, 0, 0, 0, -1, 0, 2, 0, 0, 0, 1]},
            },
        },
        "streams": {"cam": {"type": "camera"}, "lidar": {"type": "lidar"}},
        "objects": {"12": {"name": "car12", "type": "car"}},
        "frames": {
            "0": {
                "frame_properties": {"streams": {"cam": {"uri": "..\\..\\cam\\000017.png"}}},
                "objects": {"12": {"object_data": {"cuboid": [
                    {"name": "c", "coordinate_system": "lidar", "val": [0, -4, 0, 0.1, 0.2, 0.3, 4, 2, 1.5]},
                ]}}},
            },
        },
    }  # fmt: skip
    return {"openlabel": {**content, **changes}}


def written(tmp_path: Path, content: dict[str, Any]) -> Path:
    path = tmp_path / "foreign.json"
    path.write_text(json.dumps(content))
    return path


def test_boxes_with_euler_angles_are_transformed_to_the_camera(tmp_path: Path) -> None:
    ((name, frame),) = read_openlabel(written(tmp_path, foreign())).items()
    (have,) = frame.truths
    assert (name, have.label, have.track_id, frame.states) == ("000017", "car", 12, [None])
    # the LiDAR is rotated left by 90 degrees, at (1, 0, 2): its (0, -4, 0) is the vehicle's (5, 0, 2), 2 m ahead
    Rx, Ry, Rz = (Rotation.from_rotvec(np.eye(3)[axis] * angle) for axis, angle in enumerate((0.1, 0.2, 0.3)))
    R_vehicle = Rotation.from_rotvec([0, 0, np.pi / 2]) * Rz * Ry * Rx
    R_cam_vehicle = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    want = OrientedBox.from_parts(
        np.array([0.0, 0.0, 2.0]), R_cam_vehicle @ R_vehicle.as_matrix(), np.array([4, 2, 1.5])
    )
    assert_same_box(have.box, want)


def test_a_transform_in_the_frame_overrides_the_pose(tmp_path: Path) -> None:
    content = foreign()
    content["openlabel"]["frames"]["0"]["frame_properties"]["transforms"] = {
        "lidar_to_cam": {
            "src": "lidar", "dst": "cam",
            "transform_src_to_dst": {"quaternion": [0, 0, 0, 1], "translation": [0, 0, 9]},
        }
    }  # fmt: skip
    (frame,) = read_openlabel(written(tmp_path, content)).values()
    np.testing.assert_allclose(frame.truths[0].box.center_m, [0, -4, 9], atol=1e-12)


def test_static_objects_are_in_the_frames_of_their_interval(tmp_path: Path) -> None:
    cuboid = {"name": "c", "coordinate_system": "lidar", "val": [1, 2, 3, 0, 0, 0, 1, 1, 1, 1]}
    still = {
        "name": "s", "type": "pole", "object_data": {"cuboid": [cuboid]},
        "frame_intervals": [{"frame_start": 1, "frame_end": 2}],
    }  # fmt: skip
    content = foreign(objects={"0": still}, streams={"lidar": {"type": "lidar"}}, frames={"0": {}, "1": {}, "2": {}})
    frames = read_openlabel(written(tmp_path, content))
    assert {name: len(frame.truths) for name, frame in frames.items()} == {"0": 0, "1": 1, "2": 1}
    assert frames["1"].pose is of_recording, "without a camera, boxes stay in the coordinates of the cloud"


def cuboid_with(**changes: Any) -> dict[str, Any]:
    content = foreign()
    content["openlabel"]["frames"]["0"]["objects"]["12"]["object_data"]["cuboid"][0] |= changes
    return content


def numbered(uid: str) -> dict[str, Any]:
    """The document with another id for its object."""
    return json.loads(json.dumps(foreign()).replace('"12"', f'"{uid}"'))


def skewed() -> dict[str, Any]:
    content = foreign()
    content["openlabel"]["coordinate_systems"]["cam"]["pose_wrt_parent"]["matrix4x4"][0] = 1
    return content


CUBOID = r"frames\.0\.objects\.12\.object_data\.cuboid\.0"


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (cuboid_with(val=[0, 0, 0, 0, 0, 0, 0, 1, 1, 1]), CUBOID + ".*is not a unit quaternion"),
        (cuboid_with(val=[0, 0, 0, 0, 0, 0, 1, -1, 1]), CUBOID + ".*sizes must be positive"),
        (cuboid_with(coordinate_system="mars"), CUBOID + ".*the coordinate systems 'mars' and 'cam' are not connected"),
        (cuboid_with(attributes={"num": [{"name": "track_id", "val": 1.5}]}), CUBOID + ": track_id must be"),
        (numbered("1" + "0" * 17), "the object's number is its track id"),
        (foreign(streams={}), "has no stream of type camera"),
        (skewed(), "pose_wrt_parent of cam: matrix4x4 is not a rigid motion"),
    ],
)
def test_errors_of_invalid_documents_name_the_place(tmp_path: Path, content: dict[str, Any], problem: str) -> None:
    with pytest.raises(FormatError, match=r"foreign\.json: .*" + problem):
        read_openlabel(written(tmp_path, content))


def test_two_cameras_with_one_file_name_are_an_error(tmp_path: Path) -> None:
    content = foreign(streams={"cam": {"type": "camera"}, "lidar": {"type": "camera"}})
    content["openlabel"]["frames"]["0"]["frame_properties"]["streams"]["lidar"] = {"uri": "left/000017.jpg"}
    with pytest.raises(FormatError, match="the frame 000017 has labels twice"):
        read_openlabel(written(tmp_path, content))


def test_a_list_of_classes_of_another_tool_beside_an_export_is_not_read(tmp_path: Path) -> None:
    write("openlabel", tmp_path / "out", [make_item([make_label()])])
    (tmp_path / "out/classes.txt").write_text("hand\n")
    assert list(read_openlabel(tmp_path / "out")) == ["rec/000003"]
