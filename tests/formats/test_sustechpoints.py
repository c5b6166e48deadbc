"""SUSTechPOINTS' labels: what its own page writes is read, clouds open, and turned boxes keep their angles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from dataset_samples import make_item, make_label, write
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.reading import angles_xyz
from annotator.formats.sustechpoints import read_sustechpoints
from annotator.geometry.transforms import level_pose
from annotator.recordings.clouds.cloud_file import read_cloud
from annotator.workflows.importing import BoxFormat, format_of

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
