"""labelCloud, SUSTechPOINTS and nuScenes: conventions by hand, consistent tables, units of angles, errors."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import assert_same_box, make_box, make_item, make_label, write
from hypothesis import given
from hypothesis import strategies as st
from nuscenes_samples import START_US, ego_pose, mount, small
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import XYZ
from annotator.formats.frame_names import of_recording
from annotator.formats.labelcloud import read_labelcloud, vertices_object
from annotator.formats.nuscenes import read_nuscenes
from annotator.formats.reading import angles_xyz
from annotator.formats.sustechpoints import read_sustechpoints
from annotator.geometry.transforms import level_pose
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.types import OrientedBox
from annotator.types.errors import FormatError
from annotator.workflows.importing import BoxFormat, format_of

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


PSR = {
    "position": {"x": 4.1, "y": -49.7, "z": 1.8},
    "scale": {"x": 4.5, "y": 1.7, "z": 1.6},
    "rotation": {"x": 0.1, "y": -0.2, "z": 1.45},
}


def test_labels_of_its_own_page_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "data" / "example" / "label"
    folder.mkdir(parents=True)
    objects = [
        {"psr": PSR, "obj_type": "Car", "obj_id": "8", "obj_attr": "door open, occluded,lane.left"},
        {"psr": PSR, "obj_type": "Bus", "obj_id": "a-1", "obj_attr": None},
    ]
    (folder / "000950.json").write_text(json.dumps(objects))
    for path in (tmp_path / "data", tmp_path / "data" / "example", folder):
        frame = read_sustechpoints(path)["000950"]
        assert [(each.label, each.track_id) for each in frame.truths] == [("Car", 8), ("Bus", 1)]
        values = {"door open": True, "occluded": True, "lane": "left"}
        assert [each.attributes for each in frame.truths] == [values, {}]
        box = frame.truths[0].box
        x, y, z = (
            Rotation.from_euler(axis, angle).as_matrix() for axis, angle in zip("xyz", (0.1, -0.2, 1.45), strict=True)
        )
        np.testing.assert_allclose(box.rotation, x @ y @ z, atol=1e-12)
        assert (box.center_m.tolist(), box.size_m.tolist()) == ([4.1, -49.7, 1.8], [4.5, 1.7, 1.6])


def test_a_label_file_may_be_an_object_with_the_list_as_objs(tmp_path: Path) -> None:
    for folder in ("label", "list/label"):
        (tmp_path / folder).mkdir(parents=True)
    objects = [{"psr": PSR, "obj_type": "Car", "obj_id": "8"}]
    (tmp_path / "label/1.json").write_text(json.dumps({"frame": "1", "objs": objects}))
    (tmp_path / "list/label/1.json").write_text(json.dumps(objects))
    (tmp_path / "label/2.json").write_text(json.dumps({"objs": []}))
    assert format_of(tmp_path) is format_of(tmp_path / "label/1.json") is BoxFormat.SUSTECHPOINTS
    (expected,) = read_sustechpoints(tmp_path / "list")["1"].truths
    read = read_sustechpoints(tmp_path / "label")
    assert [(each.label, each.track_id) for each in read["1"].truths] == [("Car", 8)]
    np.testing.assert_array_equal(read["1"].truths[0].box.pose, expected.box.pose)
    assert read["2"].truths == []


def test_ids_of_any_text_are_tracks_of_their_scene(tmp_path: Path) -> None:
    ids = {"one/label/1": ["2", "a-1", "b", "", None], "one/label/2": ["b", " 1 ", 7], "two/label/3": ["b", str(2**60)]}
    for name, of_frame in ids.items():
        file = tmp_path / f"{name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps([{"psr": PSR, "obj_type": "Car", "obj_id": each} for each in of_frame]))
    tracks = {name: [each.track_id for each in frame.truths] for name, frame in read_sustechpoints(tmp_path).items()}
    assert tracks == {"1": [2, 3, 4, None, None], "2": [4, 1, 7], "3": [5, 6]}


@given(st.tuples(*[st.sampled_from([-np.pi, -np.pi / 2, 0.0, 0.3, np.pi / 2, 2.0])] * 3))
def test_angles_are_exact_also_where_they_are_ambiguous(angles: tuple[float, float, float]) -> None:
    rotation = Rotation.from_euler("XYZ", angles).as_matrix()
    np.testing.assert_allclose(Rotation.from_euler("XYZ", angles_xyz(rotation)).as_matrix(), rotation, atol=1e-12)


def test_written_clouds_have_the_points_with_their_colours(tmp_path: Path) -> None:
    item = make_item([make_label(track_id=3)])
    write("sustechpoints", tmp_path / "out", [item])
    (file,) = (tmp_path / "out").glob("*/lidar/*.pcd")
    raw = read_cloud(file)
    (frame,) = read_sustechpoints(tmp_path / "out").values()
    T = frame.T_camera(lambda: item.frame)
    assert T is not None
    np.testing.assert_allclose(T.apply(raw.xyz_m), item.frame.cloud.xyz_m, atol=1e-5)
    assert item.frame.cloud.rgb is not None
    np.testing.assert_array_equal(raw.rgb, item.frame.cloud.rgb)
    assert [each.track_id for each in frame.truths] == [3]


def test_texts_that_only_look_like_numbers_stay_texts(tmp_path: Path) -> None:
    written = "plate.0012,part.1_4,score.NaN,age.7,mass.1e-05,helmet.true,door open"
    (tmp_path / "1.json").write_text(json.dumps([{"psr": PSR, "obj_type": "Car", "obj_attr": written}]))
    (read,) = read_sustechpoints(tmp_path)["1"].truths
    assert read.attributes == {
        "plate": "0012", "part": "1_4", "score": "NaN", "age": 7, "mass": 1e-5, "helmet": True, "door open": True
    }  # fmt: skip


def test_an_ego_pose_puts_the_cloud_where_the_page_shows_it(tmp_path: Path) -> None:
    """Azimuth clockwise from y, then pitch about x and roll about y; the cloud half turned, 0.4 m up."""
    place = RigidTransform.from_components([701_378.25, 4_485_513.5, 640.0], Rotation.from_rotvec([1, -0.5, 0.25]))
    write("sustechpoints", tmp_path / "out", [make_item(T_world_camera=place)])
    pose = json.loads((tmp_path / "out/rec/ego_pose/rec-000003.json").read_text())
    z, x, y = np.deg2rad([-pose["azimuth"], pose["pitch"], pose["roll"]])
    Rz, Rx, Ry = (Rotation.from_rotvec(turn).as_matrix() for turn in ([0, 0, z], [x, 0, 0], [0, y, 0]))
    point = np.array([2.0, 1.0, 0.5])
    shown = Rz @ Rx @ Ry @ np.array([-2.0, -1.0, 0.5 + 0.4]) + [pose["x"], pose["y"], pose["z"]]
    level = level_pose(np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(shown, place.apply(level.inv().apply(point)), rtol=0, atol=1e-6)


def tables(out: Path) -> dict[str, list[dict[str, Any]]]:
    return {path.stem: json.loads(path.read_text()) for path in (out / "v1.0-annotator").glob("*.json")}


def test_tables_equal_those_by_hand(tmp_path: Path) -> None:
    """A level camera: its (x, y, z) is the global (z, -x, -y); the box is rotated left by 90 degrees about global z."""
    R_camera_global = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    turned = R_camera_global @ Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    box = OrientedBox.from_parts(np.array([0.5, 0.25, 0.125]), turned, np.array([4.0, 2.0, 3.0]))
    item = make_item([make_label(box, track_id=7)])
    write("nuscenes", tmp_path / "out", [item])
    found = tables(tmp_path / "out")
    (annotation,) = found["sample_annotation"]
    np.testing.assert_allclose(annotation["translation"], [0.125, -0.5, -0.25], atol=1e-12)
    assert annotation["size"] == [2.0, 4.0, 3.0]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(annotation["rotation"], [half, 0, 0, half], atol=1e-12)
    inside = np.abs((item.frame.cloud.xyz_m - box.center_m) @ box.rotation) <= box.size_m / 2
    assert annotation["num_lidar_pts"] == int(inside.all(axis=1).sum()) > 0
    assert found["instance"][0]["track_id"] == 7 and found["sample"][0]["timestamp"] == 1_700_000_000_123_456
    camera, lidar = found["calibrated_sensor"]
    np.testing.assert_allclose(camera["rotation"], [0.5, -0.5, 0.5, -0.5], atol=1e-12)
    assert camera["camera_intrinsic"] == [[5.0, 0.0, 2.5], [0.0, 5.5, 1.5], [0.0, 0.0, 1.0]]
    assert (lidar["rotation"], lidar["camera_intrinsic"]) == ([1.0, 0.0, 0.0, 0.0], [])
    scan = np.fromfile(tmp_path / "out/samples/LIDAR_TOP/rec-000003.pcd.bin", "<f4").reshape(-1, 5)
    np.testing.assert_allclose(scan[:, :3], item.frame.cloud.xyz_m @ R_camera_global, atol=1e-6)
    assert (scan[:, 3:] == 0).all()
    assert (tmp_path / "out" / found["map"][0]["filename"]).is_file()


def test_tokens_and_chains_are_consistent(tmp_path: Path) -> None:
    """Every referenced token exists, and the prev/next chains visit all rows in order."""
    items = [
        make_item([make_label(uid=f"{n}", track_id=1), make_label(uid=f"{n}b", track_id=1)], key=f"{n}", index=n)
        for n in range(3)
    ]
    items += [make_item([make_label(uid="x", label="night stand")], recording="other", timestamp_ns=None)]
    write("nuscenes", tmp_path / "out", items)
    found = tables(tmp_path / "out")
    rows = {name: {row["token"]: row for row in table} for name, table in found.items()}
    for table in found.values():
        for row in table:
            for field, value in row.items():
                if field.endswith("_token") and field[:-6] in rows:
                    assert value in rows[field[:-6]], field
    assert [scene["name"] for scene in found["scene"]] == ["rec", "other"]
    assert [instance["nbr_annotations"] for instance in found["instance"]] == [3, 3, 1]
    for instance in found["instance"]:
        chain, token = [], instance["first_annotation_token"]
        while token:
            chain.append(rows["sample_annotation"][token])
            token = chain[-1]["next"]
        assert len(chain) == instance["nbr_annotations"] and chain[-1]["token"] == instance["last_annotation_token"]
        times = [rows["sample"][each["sample_token"]]["timestamp"] for each in chain]
        assert times == sorted(times)
        assert all(a["token"] == b["prev"] for a, b in pairwise(chain))
    assert set(found["map"][0]["log_tokens"]) == set(rows["log"])


def test_scenes_with_equal_start_times_are_shifted_apart(tmp_path: Path) -> None:
    """The devkit sorts scenes by their start time and fails if two are equal."""
    at_ns, names = 1_700_000_000_000_000_000, ("a", "b", "c")
    items = [
        make_item(recording=name, key=f"{n}", timestamp_ns=at_ns + n * 500_000_000) for n in range(2) for name in names
    ]
    write("nuscenes", tmp_path / "out", items)
    found = tables(tmp_path / "out")
    time = {sample["token"]: sample["timestamp"] for sample in found["sample"]}
    first, last = ([time[scene[f"{end}_sample_token"]] for scene in found["scene"]] for end in ("first", "last"))
    assert first == [at_ns // 1000 + shift for shift in range(3)]
    assert [b - a for a, b in zip(first, last, strict=True)] == [500_000] * 3
    for row in (*found["sample_data"], *found["ego_pose"]):
        assert row["timestamp"] in time.values()


def test_splits_are_lists_of_scenes(tmp_path: Path) -> None:
    out = tmp_path / "out"
    items = [make_item([make_label()], split="train"), make_item(split="val", key="b", index=4)]
    write("nuscenes", out, [*items, make_item(recording="other", split="val")])
    assert json.loads((out / "v1.0-annotator/splits.json").read_text()) == {
        "train": ["rec-train"],
        "val": ["rec-val", "other"],
    }
    assert list(read_nuscenes(out)) == ["rec/000003", "rec/b", "other/000003"]
    with pytest.raises(FormatError, match="no folder of nuScenes tables"):
        read_nuscenes(tmp_path)


def test_each_camera_has_the_boxes_that_it_sees(tmp_path: Path) -> None:
    # the list of an export above the dataset says nothing of it
    (tmp_path / "frames.csv").write_text("id,recording,key,split\n000001,rec,a,\n")
    found = read_nuscenes(small(tmp_path / "nuscenes", scenes=1, samples=2, sweeps=0))
    names = {name.split("__")[1]: name for name in list(found)[:2]}
    assert set(names) == {"CAM_FRONT", "CAM_BACK"} and len(found) == 4
    for channel, track, delay_us, x_m in (("CAM_FRONT", 0, -15_000, 10.0), ("CAM_BACK", 1, 20_000, -8.0)):
        (truth,) = found[names[channel]].truths
        assert (truth.label, truth.track_id) == ("vehicle.car", track)
        T_camera_ego = (ego_pose(START_US + delay_us) * mount(channel)).inv() * ego_pose(START_US)
        np.testing.assert_allclose(truth.box.center_m, T_camera_ego.apply([x_m, 0.5, 1.0]), atol=1e-9)
        np.testing.assert_allclose(truth.box.rotation, T_camera_ego.rotation.as_matrix(), atol=1e-9)
    # an object of one frame is no track
    (alone, _) = read_nuscenes(small(tmp_path / "one", scenes=1, samples=1, sweeps=0)).values()
    assert [each.track_id for each in alone.truths] == [None]
    annotations, path = (
        tmp_path / "nuscenes" / "v1.0-mini" / f"{name}.json" for name in ("sample_annotation", "ego_pose")
    )
    whole = annotations.read_text()
    annotations.write_text(json.dumps([row | {"rotation": [0, 0, 0, 0]} for row in json.loads(whole)]))
    with pytest.raises(FormatError, match=r"row ap0-0ahead: rotation: .* not a unit quat"):
        read_nuscenes(tmp_path / "nuscenes")
    annotations.write_text(whole)
    for text, problem in (
        ("[]", r"sample_data\.json: row \S+: refers to the token \S+, which is not in ego_pose\.json"),
        ('[\n{"token": "F",', r"ego_pose\.json: is cut off"),
    ):
        path.write_text(text)
        with pytest.raises(FormatError, match=problem):
            read_nuscenes(tmp_path / "nuscenes")
