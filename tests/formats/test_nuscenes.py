"""nuScenes: its conventions by hand, consistent tables, and other tools' tables as seen by each camera."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import assert_same_box, make_item, make_label, write
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


# Rotates a camera's axes to those of a vehicle with the same viewing direction.
AHEAD = [0.5, -0.5, 0.5, -0.5]
LOOKS_BACK = (Rotation.from_rotvec([0, 0, np.pi]) * Rotation.from_quat(AHEAD, scalar_first=True)).as_quat(
    scalar_first=True
)


def foreign(folder: Path, **changes: Any) -> Path:
    """A vehicle at (100, 0, 0), heading left, with a front and a rear camera, and a box 10 m ahead of each."""
    left = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    K = [[500, 0, 400], [0, 500, 225], [0, 0, 1]]

    def annotation(token: str, instance: str, y: float) -> dict[str, Any]:
        where = {"translation": [100, y, 1], "rotation": left, "size": [2, 4, 1.5]}
        return {"token": token, "sample_token": "s", "instance_token": instance, **where}

    content: dict[str, list[dict[str, Any]]] = {
        "category": [{"token": "c", "name": "vehicle.car"}],
        "instance": [
            {"token": name, "category_token": "c", "nbr_annotations": n, "first_annotation_token": "",
             "last_annotation_token": ""} for name, n in (("i0", 1), ("i1", 2))
        ],
        "sensor": [{"token": n, "channel": n, "modality": "camera"} for n in ("F", "B")],
        "calibrated_sensor": [
            {"token": "F", "sensor_token": "F", "translation": [1, 0, 1], "rotation": AHEAD, "camera_intrinsic": K},
            {"token": "B", "sensor_token": "B", "translation": [-1, 0, 1], "rotation": LOOKS_BACK.tolist(),
             "camera_intrinsic": K},
        ],
        "ego_pose": [{"token": "p", "translation": [100, 0, 0], "rotation": left}],
        "sample_data": [
            {"token": n, "sample_token": "s", "ego_pose_token": "p", "calibrated_sensor_token": n, "width": 800,
             "height": 450, "is_key_frame": True, "filename": f"../../samples/{n}/{n}__17.jpg"} for n in ("F", "B")
        ],
        "sample_annotation": [annotation("a0", "i0", 11), annotation("a1", "i1", -11)],
    }  # fmt: skip
    (folder / "v1.0-mini").mkdir(parents=True)
    for name, rows in (content | changes).items():
        (folder / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    return folder


def test_each_camera_has_the_boxes_that_it_sees(tmp_path: Path) -> None:
    # the list of an export above the dataset says nothing of it
    (tmp_path / "frames.csv").write_text("id,recording,key,split\n000001,rec,a,\n")
    found = read_nuscenes(foreign(tmp_path / "nuscenes"))
    assert set(found) == {"F__17", "B__17"}
    (ahead,), (back,) = found["F__17"].truths, found["B__17"].truths
    assert (ahead.label, ahead.track_id, back.track_id) == ("vehicle.car", None, 1)
    # front camera: 10 m away, with the length along the viewing direction
    facing = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    assert_same_box(ahead.box, OrientedBox.from_parts(np.array([0.0, 0.0, 10.0]), facing, np.array([4.0, 2.0, 1.5])))
    np.testing.assert_allclose(back.box.center_m, [0, 0, 10], atol=1e-9)


ROW = {"token": "a0", "sample_token": "s", "instance_token": "i0", "translation": [100, 11, 1], "size": [2, 4, 1]}


@pytest.mark.parametrize(
    ("table", "rows", "problem"),
    [
        ("sample_annotation", [ROW | {"rotation": [0, 0, 0, 0]}], "row a0: rotation: .* not a unit quat"),
        (
            "sample_annotation",
            [ROW | {"rotation": AHEAD, "instance_token": "x"}],
            r"row a0: refers to the token x, which is not in instance\.json",
        ),
        ("ego_pose", [], r"sample_data\.json: row F: refers to the token p, which is not in ego_pose\.json"),
    ],
)
def test_errors_of_invalid_tables_name_the_place(tmp_path: Path, table: str, rows: Any, problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        read_nuscenes(foreign(tmp_path, **{table: rows}))
    (tmp_path / "v1.0-mini" / f"{table}.json").write_text('[\n{"token": "F",')
    with pytest.raises(FormatError, match=rf"{table}\.json: is cut off"):
        read_nuscenes(tmp_path / "v1.0-mini")
