"""What stands still must do so by the poses; where it moves, the check names the mistake."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rgbd_samples import write_rgbd
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.recordings import open_recording
from annotator.workflows.checking.dataset_check import check_datasets
from annotator.workflows.checking.still_world import Seen, StillWorld, off_m

HEIGHT, WIDTH, FOCAL = 60, 80, 60.0
FRAMES = 8
# Planes of a room, as normal and distance, in the world's x ahead, y left, z up: three walls, floor and ceiling.
PLANES = ((1, 0, 0, 4.0), (0, 1, 0, 2.0), (0, -1, 0, 1.5), (0, 0, -1, 0.0), (0, 0, 1, 2.6))
AHEAD = Rotation.from_matrix(np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]))
STATES = [0.0, 0.1, 0.25, 0.45, 0.5, 0.8, 0.9, 1.3]


def pose(at: int) -> RigidTransform:
    """A hand-held camera, whose speed changes."""
    way = STATES[at]
    turn = Rotation.from_euler("ZY", [0.4 * way, 0.1 + 0.2 * way]) * AHEAD
    return RigidTransform.from_components([0.5 * way, 0.3 * way, 1.2 + 0.2 * way], turn)


def depth_mm(T: RigidTransform) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, np.ones(u.shape)], axis=-1)
    rays = T.rotation.apply(rays.reshape(-1, 3))
    walls = np.array(PLANES, float)
    with np.errstate(divide="ignore"):
        away = (walls[:, 3] - T.translation @ walls[:, :3].T) / (rays @ walls[:, :3].T)
    z_m = np.where(away > 0, away, np.inf).min(axis=1)
    return np.rint(1000 * z_m).astype(np.uint16).reshape(HEIGHT, WIDTH)


def write_room(folder: Path, said: Callable[[int], RigidTransform]) -> Path:
    image = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    K = [FOCAL, 0, 0, 0, FOCAL, 0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, 1]
    write_rgbd(folder, {f"{n}": (image, depth_mm(pose(n))) for n in range(FRAMES)}, intrinsic_matrix=K)
    lines = ["key,x,y,z,qw,qx,qy,qz"]
    for n in range(FRAMES):
        T = said(n)
        numbers = [*T.translation, *T.rotation.as_quat(scalar_first=True)]
        lines.append(f"{n}," + ",".join(f"{number:.9f}" for number in numbers))
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")
    return folder


def found(folder: Path) -> dict[str, str]:
    return {each.rule: each.message for each in check_datasets(folder).findings}


def problem(folder: Path) -> str:
    recording = open_recording(folder)
    still = StillWorld(recording)
    for i in range(len(recording)):
        still.add(i, recording.frame(i))
    return still.problem() or ""


OPENGL = RigidTransform.from_rotation(Rotation.from_matrix(np.diag([1.0, -1, -1])))
BODY = RigidTransform.from_rotation(AHEAD)


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (lambda n: pose(n).inv(), "the poses lead from the world to the sensor; write their inverse"),
        (lambda n: pose(n) * OPENGL, "the poses have OpenGL's axes (x right, y up, z backward)"),
        (lambda n: pose(n) * BODY.inv(), "the poses have a vehicle's axes (x ahead, y left, z up)"),
        (lambda n: pose(max(n - 1, 0)), "each frame has the pose of the frame 1 place after it: two clocks"),
    ],
    ids=["inverse", "opengl", "vehicle", "late"],
)
def test_poses_by_which_walls_move_are_found(tmp_path: Path, said: Callable[[int], RigidTransform], why: str):
    message = problem(write_room(tmp_path, said))
    assert message.startswith("what stands still moves ") and message.endswith(
        f"by the poses in poses.csv; it stands still if {why}"
    )


def test_right_poses_and_those_of_a_camera_that_stands_still_are_not_found(tmp_path: Path):
    assert not problem(write_room(tmp_path / "moves", pose))
    still = write_room(tmp_path / "still", lambda _: pose(3))
    message = found(still)["still-world-moves"]
    assert message.startswith("what stands still moves") and "it stands still" not in message
    for n in {*range(FRAMES)} - {3}:
        shutil.copy(still / "depth" / "3.png", still / "depth" / f"{n}.png")
    assert not problem(still)


def test_gaps_and_jumps_are_findings(tmp_path: Path):
    folder = write_room(tmp_path, pose)
    lines = (folder / "poses.csv").read_text().splitlines()
    (folder / "poses.csv").write_text("\n".join([*lines[:3], *lines[4:-1], lines[-1].replace(",", ",9", 1)]) + "\n")
    messages = found(folder)
    assert messages["pose-gap"] == "1 frame without a pose: 2"
    assert messages["pose-jump"].endswith("between the frames 6 and 7")


@pytest.mark.shared
def test_real_worlds_stand_still(shared: Path, tmp_path: Path):
    """Argoverse's sweeps to 2 cm, where the car moved by 6; Open3D's depth images, by its own odometry, to 1 cm."""
    drive = open_recording(shared / "data" / "argoverse2_sample")
    room = tmp_path / "RGBD"
    shutil.copytree(shared / "data" / "rgbd_open3d_testdata" / "RGBD", room)
    shutil.copy(shared / "data" / "rgbd_open3d_testdata" / "camera_primesense.json", room / "camera_intrinsic.json")
    for recording, last, most_m in ((drive, 1, 0.02), (open_recording(room), 3, 0.01)):
        one, other = (Seen(recording.frame(i).cloud.xyz_m[::5].astype(float)) for i in (0, last))
        T = recording.pose(0).inv() * recording.pose(last)  # type: ignore[union-attr, operator]
        assert off_m(one, other, T) < most_m
        assert off_m(one, other, RigidTransform.identity()) > 2 * most_m
