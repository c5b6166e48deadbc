"""The camera's place in a map, in each format that holds it, and its loss in the others."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dataset_samples import make_item, make_label
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.kitti_objects import write_kitti
from annotator.formats.labelcloud import write_labelcloud
from annotator.formats.losses import Losses
from annotator.formats.nuscenes import read_world_poses
from annotator.formats.nuscenes_tables import write_nuscenes
from annotator.formats.openlabel import read_openlabel, write_openlabel
from annotator.formats.rcv import RcvInfo, export_rcv, read_rcv
from annotator.formats.sustechpoints import read_sustechpoints, write_sustechpoints
from annotator.geometry.transforms import level_pose
from annotator.types.errors import FormatError

# Of one recording: two places in a map, of a camera that turns in any way, and one that is not known.
PLACES = {
    "000003": RigidTransform.from_components([701_378.25, 4_485_513.5, 640.0], Rotation.from_rotvec([1, -0.5, 0.25])),
    "000004": RigidTransform.from_components([-3e6, 12.5, -0.125], Rotation.from_rotvec([0.1, 2.5, -1])),
    "000005": None,
}
UP = np.array([0.0, -1.0, 0.0])


def items() -> list[Any]:
    return [
        make_item([make_label(uid=key)], key=key, index=int(key), T_world_camera=place) for key, place in PLACES.items()
    ]


def rcv(out: Path) -> Mapping[str, RigidTransform | None]:
    export_rcv(out, items(), RcvInfo(("hand",), (), "annotator 1"))
    dataset = read_rcv(out)
    named = [dataset.named_labels(i) for i in range(len(dataset))]
    for i, (*_, pose) in enumerate(named):
        other = dataset.frame(i).frame.T_world_camera
        assert (pose is None) == (other is None)
    return {name: pose for name, _, _, pose in named}


def openlabel(out: Path) -> Mapping[str, RigidTransform | None]:
    write_openlabel(out, items(), "annotator 1")
    return {name: frame.T_world_sensor for name, frame in read_openlabel(out).items()}


def nuscenes(out: Path) -> Mapping[str, RigidTransform | None]:
    write_nuscenes(out, items(), ["hand"], Losses())
    return dict.fromkeys(f"rec/{key}" for key in PLACES) | read_world_poses(out)


def sustechpoints(out: Path) -> Mapping[str, RigidTransform | None]:
    write_sustechpoints(out, items(), Losses())
    level = level_pose(UP)
    return {
        name: None if frame.T_world_cloud is None else frame.T_world_cloud * level
        for name, frame in read_sustechpoints(out).items()
    }


@pytest.mark.parametrize("trip", [rcv, openlabel, nuscenes, sustechpoints])
def test_a_place_in_a_map_is_read_as_it_was_written(
    tmp_path: Path, trip: Callable[[Path], Mapping[str, RigidTransform | None]]
):
    found = trip(tmp_path / "out")
    assert set(found) == {f"rec/{key}" for key in PLACES}
    points = np.random.default_rng(0).normal(0, 20, (20, 3))
    for key, place in PLACES.items():
        there = found[f"rec/{key}"]
        if place is None:
            assert there is None
        else:
            assert there is not None
            np.testing.assert_allclose(there.apply(points), place.apply(points), rtol=0, atol=1e-6)


def test_an_ego_pose_puts_the_cloud_where_sustechpoints_shows_it(tmp_path: Path):
    """Its page: azimuth clockwise from y, then pitch about x and roll about y; the cloud half turned, 0.4 m up."""
    write_sustechpoints(tmp_path / "out", items(), Losses())
    pose = json.loads((tmp_path / "out/rec/ego_pose/rec-000003.json").read_text())
    z, x, y = np.deg2rad([-pose["azimuth"], pose["pitch"], pose["roll"]])
    Rz, Rx, Ry = (Rotation.from_rotvec(turn).as_matrix() for turn in ([0, 0, z], [x, 0, 0], [0, y, 0]))
    point = np.array([2.0, 1.0, 0.5])
    shown = Rz @ Rx @ Ry @ np.array([-2.0, -1.0, 0.5 + 0.4]) + [pose["x"], pose["y"], pose["z"]]
    place = PLACES["000003"]
    assert place is not None
    np.testing.assert_allclose(shown, place.apply(level_pose(UP).inv().apply(point)), rtol=0, atol=1e-6)


def test_formats_without_it_count_the_frames_whose_place_is_lost(tmp_path: Path):
    ids = {("rec", key): key for key in PLACES}
    kitti, cloud = Losses(), Losses()
    write_kitti(tmp_path / "kitti", items(), ids, ["hand"], kitti)
    write_labelcloud(tmp_path / "labelcloud", items(), ["hand"], cloud, "1")
    for losses in (kitti, cloud):
        (line,) = [loss for loss in losses.report() if loss.kind == "origin"]
        assert line.message == "2 frames have a place in a map; boxes and points were written relative to the camera"


@pytest.mark.parametrize("damaged", [[0, 0, 0, 0], [1, 0, 0]])
def test_a_damaged_place_is_an_error_of_its_file(tmp_path: Path, damaged: list[float]):
    export_rcv(tmp_path / "out", items(), RcvInfo(("hand",), (), "annotator 1"))
    file = tmp_path / "out/labels/rec-000003.json"
    content = json.loads(file.read_text())
    content["world"]["quaternion"] = damaged
    file.write_text(json.dumps(content))
    with pytest.raises(FormatError, match=r"rec-000003\.json.*world"):
        read_rcv(tmp_path / "out").named_labels(0)
