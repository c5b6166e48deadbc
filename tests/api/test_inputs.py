"""The Python API's names and input arrays: the error of an ambiguous one says what to do."""

from __future__ import annotations

import ast
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import annotator
from annotator import api
from annotator.api.project import Given
from annotator.api.proposing import Options
from annotator.image_bytes import decode_image
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


ROOT = Path(__file__).resolve().parents[2]
NAMES = set(annotator.__all__) - {"__version__"}
HEAVY = ("numpy", "torch", "open3d", "viser", "cv2", "scipy", "numba", "sqlalchemy", "pydantic", "ultralytics")


def test_import_loads_no_heavy_package() -> None:
    script = f"import annotator, json, sys; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    answer = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert json.loads(answer.stdout) == []


def test_the_package_exports_the_names_of_the_api() -> None:
    for name in NAMES:
        assert getattr(annotator, name) is getattr(api, name)
    assert set(annotator.__all__) <= set(dir(annotator))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Boxes'"):
        _ = annotator.Boxes  # type: ignore[attr-defined]


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((ROOT / "annotator/api/__init__.py").read_text(encoding="utf-8"))
    exported = {x.asname for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for x in node.names}
    assert exported == NAMES
    assert (ROOT / "annotator/py.typed").is_file()


def test_type_checkers_see_the_options_of_functions_for_one_frame_or_several() -> None:
    for function, options in ((annotator.propose, Options), (annotator.Project.detect, Given)):
        taken = {each.name for each in signature(function).parameters.values() if each.kind is each.KEYWORD_ONLY}
        assert set(options.__annotations__) == taken


def test_the_guide_has_a_row_for_every_name() -> None:
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    rows = {name for row in re.findall(r"^\|(.*?)\|", text, re.MULTILINE) for name in re.findall(r"`(\w+)", row)}
    assert rows >= NAMES, f"docs/python.md does not mention {sorted(NAMES - rows)}"


EXAMPLES = sorted((ROOT / "docs/examples").glob("*.py"))
MAX_LINES = 40
# What each example must print.
EXPECTED_OUTPUT = {
    "01": r"(hand: centre .* m, size .* m, \d\.\d\d\n){2}",
    "02": r"(frame \d+: 2 2D boxes, 2 3D boxes\n){2}",
    "03": r"step 1: 2 views, .*continues\nstep 2: 24 views",
    "04": r"3 frames done, 0 were done before, 0 failed\n(.*\n)+0 frames done, 3 were done before, 0 failed\n",
    "05": r"rcv +2 +6 +1\.0000\nkitti +2 +6 (.*\n)+openlabel +2 +6 +1\.0000\n(.*\n)+boxes\.json: room/000000",
    "06": r"exact views\n.*\n +hand +6 +6 +1\.00(.*\n)+nearest cluster",
    "07": r"frame \d+: 2 boxes in \d+ ms, 2 warm starts\n",
    "08": r"8 frames, 16 boxes, 0 failed(.*\n)+000007 +.* cm  .* cm\n",
}


def test_all_examples_are_short_and_in_the_guide() -> None:
    assert [path.name[:2] for path in EXAMPLES] == sorted(EXPECTED_OUTPUT)
    text = (ROOT / "docs/python.md").read_text(encoding="utf-8")
    for path in EXAMPLES:
        assert len(path.read_text(encoding="utf-8").splitlines()) < MAX_LINES, path.name
        assert f"examples/{path.name}" in text, f"docs/python.md does not mention {path.name}"


# Runs scripts one after the other in one process, so that torch is loaded once.
RUN = """
import contextlib, pathlib, os, runpy, sys, traceback
scripts = list(zip(sys.argv[1::2], sys.argv[2::2]))
for script, folder in scripts:
    os.chdir(folder)
    sys.argv = [script]
    with open("printed.txt", "w", encoding="utf-8") as printed, contextlib.redirect_stdout(printed):
        try:
            runpy.run_path(script, run_name="__main__")
        except BaseException:
            pathlib.Path("error.txt").write_text(traceback.format_exc(), encoding="utf-8")
"""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Path]:
    """The folder in which each example has run."""
    if find_spec("ray") is None:
        pytest.skip("ray is not installed; run scripts/setup test")
    made = {path: tmp_path_factory.mktemp(path.stem) for path in EXAMPLES}
    arguments = [part for pair in made.items() for part in pair]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    ran = subprocess.run([sys.executable, "-c", RUN, *arguments], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    return made


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_runs(path: Path, folders: dict[Path, Path]) -> None:
    error, printed = folders[path] / "error.txt", (folders[path] / "printed.txt").read_text(encoding="utf-8")
    assert not error.exists(), error.read_text(encoding="utf-8")
    assert re.search(EXPECTED_OUTPUT[path.name[:2]], printed), printed
    written = sorted(folders[path].glob("*.png"))
    assert [picture.name for picture in written] == re.findall(r"Writes (\S+\.png)", path.read_text(encoding="utf-8"))
    for picture in written:
        # green edges of a box, or the red ones on pseudo-views
        blue, green, red = np.moveaxis(decode_image(picture.read_bytes(), 1).astype(int), -1, 0)
        edges = ((green > red + 100) & (green > blue + 60)) | ((red > green + 120) & (red > blue + 120))
        assert edges.sum() > 100, picture.name
