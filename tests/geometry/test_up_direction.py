"""The up direction estimated from planes: right on generated rooms, refused where nothing tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.projection import unproject_depth
from annotator.geometry.up_direction import UpEstimate, estimate_up
from annotator.synthetic.snapshots import snapshot
from annotator.types import Camera, Frame, PointCloud
from annotator.workflows.recorded.adjusting import LEAST_CERTAINTY, agreed_up

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)
LEVEL = np.array([0.0, -1.0, 0.0])


def planes_frame(up: np.ndarray, *, floor: bool = True, walls: bool = True, seed: int = 0) -> Frame:
    """A noisy depth image of a floor 1.2 m below the camera and of two walls."""
    random = np.random.default_rng(seed)
    turn = Rotation.align_vectors(up[None], LEVEL[None])[0]
    rays = np.dstack(
        [
            *np.meshgrid((np.arange(320) - 159.5) / 260.0, (np.arange(240) - 119.5) / 260.0),
            np.ones((240, 320)),
        ]
    )
    depth = np.full((240, 320), np.inf)
    walls_at = [((-0.6, 0.0, -0.8), -3.0), ((0.8, 0.0, -0.6), -3.5)]
    for normal, offset in [*([((0.0, -1.0, 0.0), -1.2)] if floor else []), *(walls_at if walls else [])]:
        along = rays @ turn.apply(normal)
        with np.errstate(divide="ignore"):
            z = offset / along
        depth = np.where((z > 0) & (z < depth), z, depth)
    depth = np.where(np.isfinite(depth) & (depth < 8), depth * random.normal(1, 0.002, depth.shape), 0.0)
    xyz, pixel = unproject_depth(CAMERA, depth.astype(np.float32))
    rgb = np.zeros((240, 320, 3), np.uint8)
    return Frame("0", 0, CAMERA, rgb, PointCloud(xyz, pixel_index=pixel), depth.astype(np.float32))


def degrees(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("roll_deg", [-20, 12])
@pytest.mark.parametrize("pitch_deg", [35, -10])
def test_a_room_tells_its_up_direction_whatever_the_tilt(roll_deg: int, pitch_deg: int):
    turn = Rotation.from_euler("xz", [pitch_deg, roll_deg], degrees=True)
    up = turn.apply(LEVEL)
    found = estimate_up(planes_frame(up))
    assert found is not None
    assert degrees(found.up, up) < 0.5
    assert found.certainty > LEAST_CERTAINTY


def test_one_wall_alone_is_refused():
    rgb = np.zeros((240, 320, 3), np.uint8)
    depth = np.random.default_rng(0).normal(2, 0.004, (240, 320)).astype(np.float32)
    xyz, pixel = unproject_depth(CAMERA, depth)
    found = estimate_up(Frame("0", 0, CAMERA, rgb, PointCloud(xyz, pixel_index=pixel), depth))
    assert found is None or found.certainty < LEAST_CERTAINTY


@pytest.mark.parametrize("points", [0, 40, 3000])
def test_points_without_planes_are_refused(points: int):
    xyz = np.random.default_rng(1).normal((0, 0, 4), 1, (points, 3)).astype(np.float32)
    rgb = np.zeros((240, 320, 3), np.uint8)
    found = estimate_up(Frame("0", 0, CAMERA, rgb, PointCloud(xyz)))
    assert found is None or found.certainty < LEAST_CERTAINTY


def test_a_cloud_without_a_depth_image_tells_as_well():
    up = Rotation.from_euler("x", -15, degrees=True).apply(LEVEL)
    frame = planes_frame(up)
    keep = np.arange(0, len(frame.cloud), 7)
    bare = replace(frame, cloud=PointCloud(frame.cloud.xyz_m[keep]), depth_m=None)
    found = estimate_up(bare)
    assert found is not None
    assert degrees(found.up, up) < 1


def test_generated_arrangements_are_right_or_refused():
    checked = 0
    for seed in range(3, 9):
        frame = snapshot(seed, 7).frame
        found = estimate_up(replace(frame, up=None))
        if found is not None and found.certainty >= LEAST_CERTAINTY:
            assert frame.up is not None
            assert degrees(found.up, frame.up) < 2, seed
            checked += 1
    assert checked >= 4


def estimate(degrees_off: float, certainty: float = 0.9) -> UpEstimate:
    return UpEstimate(Rotation.from_euler("x", degrees_off, degrees=True).apply(LEVEL), certainty, 0.3, 0.3)


def test_frames_that_agree_give_one_direction():
    agreed = agreed_up([estimate(0.0), estimate(1.0), estimate(2.0), None, estimate(70.0, 0.1)])
    assert agreed.up is not None
    assert degrees(np.array(agreed.up), estimate(1.0).up) < 0.1
    assert (agreed.frames, agreed.agreeing) == (5, 3)
    assert np.degrees(agreed.spread_rad) == pytest.approx(1, abs=0.1)


def test_a_camera_that_turns_has_no_direction():
    agreed = agreed_up([estimate(float(angle)) for angle in (0, 10, 20, 30)])
    assert agreed.up is None
    assert "30 degrees" in agreed.reason


def test_uncertain_frames_are_refused_with_a_reason():
    assert "do not tell" in agreed_up([estimate(0.0, 0.3), estimate(0.0, 0.4)]).reason
    assert "no frame" in agreed_up([None, None]).reason
