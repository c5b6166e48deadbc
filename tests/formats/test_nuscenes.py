"""nuScenes: its conventions by hand, consistent tables, and other tools' tables as seen by each camera."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import make_item, make_label, write
from nuscenes_samples import START_US, ego_pose, mount, small
from scipy.spatial.transform import Rotation

from annotator.formats.nuscenes import read_nuscenes
from annotator.types import OrientedBox
from annotator.types.errors import FormatError


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
