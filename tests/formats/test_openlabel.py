"""OpenLABEL and rcv: conventions, self-contained and whole data sets, other tools' documents, errors."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import assert_same_box, make_box, make_item, make_label, write
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetItem, Detector
from annotator.formats.frame_names import of_recording
from annotator.formats.openlabel import read_openlabel
from annotator.formats.rcv import RcvManifest, labelled_frames, read_rcv
from annotator.recordings import open_recording
from annotator.types import BoxKind, Camera, Frame, Label, OrientedBox, PointCloud, ReviewState, Source, Suggestion
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


CAMERA = Camera(6, 4, 5.0, 5.5, 2.5, 1.5, (0.1, -0.2, 0.001, 0.002, 0.05))
CLASSES, DETECTORS = ("hand", "Büro | 1"), (Detector("image", "yolo11n", "abc123"),)


def export(out: Path, items: Sequence[DatasetItem], **options: Any) -> RcvManifest:
    write("rcv", out, items, **({"classes": CLASSES, "detectors": DETECTORS} | options))
    return read_rcv(out).manifest


def auto_label(box: OrientedBox | None = None, **changes: Any) -> Label:
    """A label with all optional fields."""
    known = {"score": 0.75, "source": Source.AUTO, "time_ns": 1_700_000_000_123_456_789, "track_id": 4}
    known |= {"expected_iou_loss": 0.125, "suggestion": Suggestion("base detector", "f00d", corrected=True)}
    known |= {"box_kind": BoxKind.SILHOUETTE}
    return make_label(box, **{**known, **changes})


def make_frame(key: str = "000001", *, rgb: bool = True, reflectance: bool = False, n: int = 5) -> Frame:
    rng = np.random.default_rng(len(key) + n)
    cloud = PointCloud(
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.integers(0, 256, (n, 3), np.uint8) if rgb else None,
        rng.random(n, np.float32) if reflectance else None,
    )
    image = rng.integers(0, 256, (4, 6, 3), np.uint8)
    return Frame(key, 3, CAMERA, image, cloud, up=np.array([0.0, -1.0, 0.0]), timestamp_ns=17)


@pytest.mark.parametrize(("rgb", "reflectance"), [(True, True), (False, False)])
def test_frame_reads_back_bit_for_bit(tmp_path: Path, rgb: bool, reflectance: bool) -> None:
    frame, label = make_frame(rgb=rgb, reflectance=reflectance), auto_label()
    export(tmp_path / "out", [DatasetItem("rec", frame, [label])])
    dataset, back = read_rcv(tmp_path / "out"), open_recording(tmp_path / "out").frame(0)
    assert (len(dataset), back.key, back.timestamp_ns, dataset.place(0)) == (1, "rec-000001", 17, ("rec", 3))
    assert vars(back.camera) == vars(CAMERA)
    np.testing.assert_array_equal(back.up, [0, -1, 0])
    np.testing.assert_array_equal(back.rgb, frame.rgb)
    np.testing.assert_array_equal(back.cloud.xyz_m, frame.cloud.xyz_m)
    for have, want in ((back.cloud.rgb, frame.cloud.rgb), (back.cloud.reflectance, frame.cloud.reflectance)):
        assert (have is None) == (want is None)
        if have is not None and want is not None:
            np.testing.assert_array_equal(have, want)
    found = dataset.labelled(0)[1]
    (read,) = found.truths
    assert (read.label, read.score, read.track_id, read.box_kind) == ("hand", 0.75, 4, BoxKind.SILHOUETTE)
    assert found.states == (label.state,)
    (entry,) = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())["objects"]
    assert (entry["uid"], entry["author"], entry["time_ns"]) == (label.uid, label.author, label.time_ns)
    assert (entry["source"], entry["expected_iou_loss"]) == ("auto", 0.125)
    assert entry["suggestion"] == {"detector": "base detector", "fingerprint": "f00d", "corrected": True}


def test_json_has_the_box_as_matrix_quaternion_and_corners(tmp_path: Path) -> None:
    """A quarter turn about the camera's z: length along y, width along -x."""
    box = make_box((1.0, 2.0, 3.0), (0.0, 0.0, np.pi / 2), (4.0, 2.0, 1.0))
    export(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label(box, score=None, track_id=None)])])
    content = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())
    (entry,) = content["objects"]
    assert entry["center"] == [1.0, 2.0, 3.0]
    assert entry["size"] == [4.0, 2.0, 1.0]
    np.testing.assert_allclose(entry["rotation"], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(entry["quaternion"], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-12)
    corners = np.array(entry["corners"])
    assert corners.shape == (4, 8)
    np.testing.assert_allclose(corners[:, 0], [2.0, 0.0, 2.5, 1], atol=1e-12)  # ---
    np.testing.assert_allclose(corners[:, 1], [2.0, 4.0, 2.5, 1], atol=1e-12)  # +--
    np.testing.assert_allclose(corners[:, 6], [0.0, 4.0, 3.5, 1], atol=1e-12)  # +++
    assert (entry["score"], entry["track_id"], entry["source"], entry["state"]) == (None, None, "auto", "accepted")
    assert content["camera"]["distortion"] == [0.1, -0.2, 0.001, 0.002, 0.05]


def test_the_manifest_counts_frames_objects_and_points(tmp_path: Path) -> None:
    frames = [make_frame(key) for key in ("000001", "000002")]
    items = [
        DatasetItem("a", frames[0], [auto_label(uid="1"), auto_label(uid="2", label="Büro | 1", source=Source.MANUAL)]),
        DatasetItem("a", frames[1], []),
        DatasetItem("b/x", frames[0], [auto_label(uid="3", state=ReviewState.EDITED)]),
    ]
    manifest = export(tmp_path / "out", items)
    assert manifest.frames == ("a-000001", "a-000002", "b_x-000001")
    assert (manifest.counts.frames, manifest.counts.objects, manifest.counts.points) == (3, 3, 15)
    assert manifest.counts.objects_by_class == {"hand": 2, "Büro | 1": 1}
    assert manifest.counts.objects_by_state == {"proposed": 0, "accepted": 2, "edited": 1, "rejected": 0}
    assert manifest.counts.objects_by_source == {"manual": 1, "auto": 2, "imported": 0}
    assert manifest.counts.objects_by_recording == {"a": 2, "b/x": 1}
    assert [use.recordings for use in manifest.cameras] == [("a", "b/x")]
    assert manifest.detectors == DETECTORS


def test_readme_describes_every_field_and_its_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    export(tmp_path / "out", [DatasetItem("rec", make_frame(), [auto_label()])])
    text = (tmp_path / "out/README.md").read_text(encoding="utf-8")
    entry = json.loads((tmp_path / "out/labels/rec-000001.json").read_text())
    for name in (*entry["objects"][0], "up", "camera", "timestamp_ns"):
        assert f"`{name}`" in text
    assert r"Büro \| 1" in text
    (code,) = re.findall(r"Example, in Python:\n\n((?:    .*\n|\n)+)", text)
    monkeypatch.chdir(tmp_path / "out")
    exec(textwrap.dedent(code), {})
    assert capsys.readouterr().out.startswith("hand accepted [")


def edit(path: Path, **changes: Any) -> None:
    content = json.loads(path.read_text())
    target = content["objects"][0] if "objects" in content and "objects" not in changes else content
    target.update(changes)
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("file", "changes", "says"),
    [
        ("labels/rec-000001.json", {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "quaternion and rotation disagree"),
        ("labels/rec-000001.json", {"center": [9, 9, 9]}, "corners disagree"),
        ("labels/rec-000001.json", {"objects": [], "image": "../../secret.png"}, "leads out of the folder"),
        ("dataset.json", {"version": 2}, "version"),
        ("dataset.json", {"frames": []}, "frames must list 1 different ids"),
    ],
)
def test_errors_of_a_broken_dataset_name_the_place(
    tmp_path: Path, file: str, changes: dict[str, Any], says: str
) -> None:
    out = tmp_path / "out"
    export(out, [DatasetItem("rec", make_frame(), [auto_label()])])
    edit(out / file, **changes)
    with pytest.raises(FormatError, match=re.escape(says)):
        read_rcv(out).labelled(0)


def test_a_frame_that_occurs_twice_is_refused(tmp_path: Path) -> None:
    items = [DatasetItem("rec", make_frame(key), [auto_label()]) for key in ("a", "b")]
    _, second = export(tmp_path / "out", items).frames
    edit(tmp_path / f"out/labels/{second}.json", key="a", objects=[])
    with pytest.raises(FormatError, match="the frame rec/a has labels twice"):
        labelled_frames(tmp_path / "out")
