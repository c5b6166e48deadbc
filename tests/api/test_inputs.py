"""Input arrays: unambiguous ones are converted; the error of an ambiguous one says what to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import annotator
from annotator.types.errors import AnnotatorError, ArgumentError

H, W = 24, 32
K = np.array([[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]])
RGB = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
DEPTH = np.full((H, W), 2.0, np.float32)
# x forward, y left, z up, as most LiDARs have it
OF_T = "T_camera_points"
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def rgbd(rgb: Any = RGB, depth: Any = DEPTH, intrinsics: Any = K, **more: Any) -> annotator.Frame:
    return annotator.frame_from_rgbd(rgb, depth, intrinsics, **more)


def lidar_points() -> np.ndarray:
    """Points in all directions, as from a rotating LiDAR."""
    rng = np.random.default_rng(1)
    angle, height = rng.uniform(-np.pi, np.pi, 4000), rng.uniform(-1, 1, 4000)
    return np.stack([10 * np.cos(angle), 10 * np.sin(angle), height], axis=1)


def cloud(
    points: Any = None, T: Any = T_CAMERA_LIDAR, intrinsics: Any = K, rgb: Any = RGB, **more: Any
) -> annotator.Frame:
    return annotator.frame_from_points(rgb, lidar_points() if points is None else points, intrinsics, T, **more)


def refused(call: Callable[[], object], *words: str) -> None:
    """Expects an ArgumentError, which is also a ValueError, with all `words` in its message."""
    with pytest.raises(ArgumentError) as caught:
        call()
    assert isinstance(caught.value, AnnotatorError) and isinstance(caught.value, ValueError)
    for word in words:
        assert word in str(caught.value)


def test_a_frame_has_one_point_per_pixel_with_depth() -> None:
    frame = rgbd(key="a", up=(0, -2, 0))
    assert (frame.key, len(frame.cloud), frame.camera.fx) == ("a", H * W, 30.0)
    assert frame.up is not None and frame.up.tolist() == [0, -1, 0]
    corner = [(0 - 15.5) / 30 * 2, (0 - 11.5) / 30 * 2, 2]
    np.testing.assert_allclose(frame.cloud.xyz_m[0], corner, atol=1e-6)
    assert frame.cloud.rgb is not None and (frame.cloud.rgb[0] == RGB[0, 0]).all()


@pytest.mark.parametrize(
    "given",
    [RGB / 255.0, (RGB / 255.0).astype(np.float32), np.dstack([RGB, RGB[..., :1]]), RGB.tolist()],
    ids=["floats", "float32", "RGBA", "nested lists of integers"],
)
def test_float_and_rgba_images_are_converted(given: Any) -> None:
    if isinstance(given, list):
        refused(lambda: rgbd(given), "int64", "uint8")  # int64 does not show whether the range is 0..1 or 0..255
        return
    assert (rgbd(given).rgb == RGB).all()
    assert (rgbd(RGB[..., 0]).rgb == RGB[..., :1]).all()


def test_integer_depth_is_millimetres_and_float_depth_is_metres() -> None:
    expected = rgbd().cloud.xyz_m
    for depth in (np.full((H, W), 2000, np.uint16), np.full((H, W), 2000, np.int32), np.full((H, W, 1), 2000)):
        assert (rgbd(depth=depth).cloud.xyz_m == expected).all()
    assert (rgbd(depth=np.full((H, W), 2), depth_scale=1.0).cloud.xyz_m == expected).all()
    assert (rgbd(depth=np.full((H, W), 10000, np.uint16), depth_scale=5000.0).cloud.xyz_m == expected).all()
    assert (rgbd(depth=np.full((H, W), 2000.0), depth_scale=1000.0).cloud.xyz_m == expected).all()


def test_zero_and_non_finite_depth_gives_no_points() -> None:
    depth = DEPTH.copy()
    depth[0, :4] = [0, np.nan, np.inf, -np.inf]
    frame = rgbd(depth=depth)
    assert len(frame.cloud) == H * W - 4
    assert frame.depth_m is not None and (frame.depth_m[0, :4] == 0).all()


@pytest.mark.parametrize("make", [rgbd, cloud], ids=["rgbd", "points"])
def test_intrinsics_are_a_matrix_four_numbers_or_a_camera(make: Callable[..., annotator.Frame]) -> None:
    camera = annotator.Camera(W, H, 30.0, 30.0, 15.5, 11.5)
    for given in (K, K.tolist(), (30, 30, 15.5, 11.5), camera):
        assert make(intrinsics=given).camera == camera or make(intrinsics=given).camera.matrix.tolist() == K.tolist()
    assert make(distortion=(0.1, 0.0, 0.0, 0.0)).camera.distortion == (0.1, 0.0, 0.0, 0.0)


def test_points_are_transformed_to_the_camera_and_coloured_by_their_pixel() -> None:
    points = np.array([[2.0, 0, 0], [2, 0.1, 0], [-2, 0, 0], [np.nan, 0, 0], [0.05, 0, 0], [2, 9, 0]])
    frame = cloud(points, reflectance=np.linspace(0, 1, 6))
    np.testing.assert_allclose(frame.cloud.xyz_m, [[0, 0, 2], [-0.1, 0, 2]], atol=1e-6)
    assert frame.cloud.rgb is not None and frame.cloud.reflectance is not None
    assert frame.cloud.rgb.tolist() == [RGB[12, 16].tolist(), RGB[12, 14].tolist()]
    np.testing.assert_allclose(frame.cloud.reflectance, [0, 0.2], atol=1e-6)


def test_a_transform_is_a_matrix_or_a_rigid_transform_and_defaults_to_the_identity() -> None:
    expected = cloud().cloud.xyz_m
    assert len(expected) > 100
    T = RigidTransform.from_matrix(T_CAMERA_LIDAR)
    assert (cloud(T=T).cloud.xyz_m == expected).all()
    assert (cloud(T.apply(lidar_points()), T=None).cloud.xyz_m == expected).all()


def test_points_in_map_coordinates_are_precise_and_zeros_are_no_returns() -> None:
    near = cloud()
    place = np.array([701_378.25, 4_485_513.5, 640.75])
    T = T_CAMERA_LIDAR.copy()
    T[:3, 3] -= T[:3, :3] @ place
    points = np.vstack([np.zeros((500, 3)), lidar_points() + place])
    far = cloud(points, T=T)
    np.testing.assert_allclose(far.cloud.xyz_m, near.cloud.xyz_m, atol=1e-4)
    assert near.T_world_camera is None and far.T_world_camera is not None
    np.testing.assert_allclose(far.T_world_camera.translation, place, atol=1e-6)
    refused(lambda: cloud(points, T=T_CAMERA_LIDAR), "for map coordinates the T_camera_points")


def test_points_outside_the_image_are_an_error_with_the_likely_cause() -> None:
    behind = np.array([[0.0, 0, -2], [0, 0.1, -2], [0.1, 0, -3]])
    refused(lambda: cloud(behind, T=None), "0 of 3 points lie on the image", "0 are in front")
    # the LiDAR's own frame is not the camera's
    ahead = lidar_points()[:, :] * [1, 1, 0.1]
    refused(lambda: cloud(ahead[ahead[:, 0] > 5], T=None), "check T_camera_points", "z up", "p_camera = T @ p_points")


WRONG: dict[str, tuple[Callable[..., object], dict[str, Any], list[str]]] = {
    "floats to 255": (rgbd, {"rgb": RGB.astype(np.float64)}, ["0..1", "astype"]),
    "16 bits": (rgbd, {"rgb": RGB.astype(np.uint16)}, ["uint16", "uint8"]),
    "channels first": (rgbd, {"rgb": np.moveaxis(RGB, -1, 0)}, ["(H, W, 3)", "moveaxis"]),
    "two channels": (rgbd, {"rgb": RGB[..., :2]}, ["(H, W, 3)"]),
    "NaN": (rgbd, {"rgb": np.where(RGB[0, 0] == RGB, np.nan, RGB / 255.0)}, ["NaN"]),
    "depth in millimetres": (rgbd, {"depth": DEPTH * 1000}, ["2000", "metres", "depth_scale=1000"]),
    "small integers as depth": (rgbd, {"depth": DEPTH.astype(np.int64)}, ["integers up to 2", "depth_scale"]),
    "depth of another size": (rgbd, {"depth": DEPTH[:-1]}, ["(23, 32)", "(24, 32)", "register"]),
    "no depth": (rgbd, {"depth": np.zeros_like(DEPTH)}, ["no pixel has a depth"]),
    "negative depth": (rgbd, {"depth": -DEPTH}, ["negative", "z points away"]),
    "no scale": (rgbd, {"depth_scale": 0.0}, ["positive"]),
    "transposed matrix": (rgbd, {"intrinsics": K.T}, ["transposed", "K.T"]),
    "homogeneous by 2": (rgbd, {"intrinsics": np.diag([30.0, 30, 2])}, ["0 0 1"]),
    "projection": (rgbd, {"intrinsics": np.hstack([K, np.zeros((3, 1))])}, ["(3, 4)"]),
    "skew": (rgbd, {"intrinsics": K + np.array([[0, 3, 0], [0, 0, 0], [0, 0, 0]])}, ["skew"]),
    "other resolution": (rgbd, {"intrinsics": (15.5, 11.5, 300, 300)}, ["principal point", "resolution"]),
    "fractions": (rgbd, {"intrinsics": (0.9, 1.2, 0.5, 0.5)}, ["pixels", "fractions"]),
    "no focal length": (rgbd, {"intrinsics": (np.nan, 30, 15.5, 11.5)}, ["finite"]),
    "camera of another size": (
        rgbd, {"intrinsics": annotator.Camera(64, 48, 60.0, 60.0, 31.5, 23.5)}, ["64 x 48", "32 x 24"]
    ),
    "two coefficients": (rgbd, {"distortion": (0.1, 0.2)}, ["coefficients"]),
    "mirror": (cloud, {"T": np.diag([1.0, -1, 1, 1]) @ T_CAMERA_LIDAR}, [OF_T, "mirror", "-1"]),
    "scale": (cloud, {"T": np.diag([2.0, 2, 2, 1]) @ T_CAMERA_LIDAR}, [OF_T, "scale"]),
    "three rows": (cloud, {"T": T_CAMERA_LIDAR[:3]}, [OF_T, "(4, 4)"]),
    "transposed transform": (
        cloud, {"T": np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]])}, [OF_T, "transposed"]
    ),
    "no transform": (cloud, {"T": np.full((4, 4), np.nan)}, [OF_T, "finite"]),
    "two transforms": (cloud, {"T": RigidTransform.from_rotation(Rotation.identity(2))}, [OF_T, "not a stack"]),
    "transposed points": (cloud, {"points": lidar_points().T}, ["xyz.T"]),
    "four columns": (
        cloud, {"points": np.hstack([lidar_points(), np.ones((4000, 1))])}, ["(4000, 4)", "reflectance"]
    ),
    "organised points": (cloud, {"points": lidar_points().reshape(40, 100, 3)}, ["reshape"]),
    "no finite point": (cloud, {"points": np.full((5, 3), np.nan)}, ["no finite point"]),
    "points in millimetres": (cloud, {"points": lidar_points() * 1000}, ["millimetres"]),
    "few reflectances": (cloud, {"reflectance": np.ones(7)}, ["(4000,)"]),
    "reflectances to 255": (cloud, {"reflectance": np.full(4000, 255.0)}, ["0..1"]),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_ambiguous_and_unusable_inputs_are_errors(name: str) -> None:
    make, given, words = WRONG[name]
    refused(lambda: make(**given), *words)


def test_an_up_without_length_is_an_error() -> None:
    with pytest.raises(ValueError):
        rgbd(up=(0, 0, 0))
