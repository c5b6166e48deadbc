"""Pseudo-views: pixels, nearest points and metres; and the fit of a box to intervals on them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners
from annotator.rcv import interval_fit
from annotator.rcv.config import RcvConfig
from annotator.rcv.interval_fit import BoxFit, Intervals, fit_box
from annotator.rcv.pseudo_view import (
    BACKGROUND,
    KeyLayout,
    draw_views,
    fit_windows,
    is_deep,
    pack_colors,
    render_pairs,
    splat_px,
)
from annotator.rcv.recursion import plan_step, start
from annotator.rcv.rotations import near_axes, spread_rotations, wide_axes
from annotator.types import Box2D, OrientedBox, PointCloud

VIEW = 100


def cloud_of(points: list[list[float]], colors: list[list[int]] | None = None) -> PointCloud:
    rgb = None if colors is None else np.array(colors, np.uint8)
    return PointCloud(np.array(points, np.float32), rgb)


def pixel_of(view, point) -> tuple[int, int]:
    uv = (view.axes[:2] @ np.asarray(point, np.float64) - view.origin_m) / view.metres_per_px
    return int(np.rint(uv[1])), int(np.rint(uv[0]))


@given(st.floats(-0.5, 60), st.floats(-0.5, 60), st.floats(1, 30), st.floats(1, 30))
def test_conversion_to_metres_and_back_keeps_a_box(x: float, y: float, width: float, height: float) -> None:
    front, _ = render_pairs(cloud_of([[0, 0, 1], [1, 2, 2]]), [np.eye(3)], VIEW)
    box = Box2D("a", x, y, x + width, y + height)
    again = front.box_px(front.interval_m(box), "a")
    assert again.xyxy == pytest.approx(box.xyxy, abs=1e-9)


def test_additional_points_lie_within_the_view() -> None:
    corners = np.array([[-3.0, 0, 1], [3, 0, 1]])
    front, _ = render_pairs(cloud_of([[0, 0, 1], [0.1, 0.1, 1]]), [np.eye(3)], VIEW, corners)
    assert front.origin_m[0] < -3 and front.origin_m[0] + front.extent_m[0] > 3


def test_points_without_colour_are_shaded_by_depth_or_reflectance() -> None:
    points = np.array([[0, 0, 1], [1, 1, 3]], np.float32)
    by_depth = render_pairs(PointCloud(points), [np.eye(3)], VIEW)[0]
    assert by_depth.rgb[pixel_of(by_depth, points[0])][0] > by_depth.rgb[pixel_of(by_depth, points[1])][0]
    cloud = PointCloud(points, reflectance=np.array([0.0, 1.0], np.float32))
    shown = render_pairs(cloud, [np.eye(3)], VIEW)[0]
    assert shown.rgb[pixel_of(shown, points[0])][0] < shown.rgb[pixel_of(shown, points[1])][0]
    assert shown.rgb[0, -1, 0] == BACKGROUND


VIEWS = 3


def reference(xyz, rgb, axes, window):
    """The picture of one view, point by point from far to near."""
    right, down, depth = axes @ xyz
    left, top = (window.origin_m - window.metres_per_px / 2).astype(np.float32)
    scale = np.float32(1 / window.metres_per_px)
    column = np.clip(((right - left) * scale).astype(int), 0, window.width_px - 1)
    row = np.clip(((down - top) * scale).astype(int), 0, window.height_px - 1)
    n, layout = len(depth), KeyLayout.of(len(depth))
    near = depth.min()
    level = ((depth - near) * np.float32(layout.scale(float(near), float(depth.max())))).astype(int)
    order = np.lexsort([-np.arange(n), -level])
    first = np.full((window.height_px, window.width_px), n, np.float64)
    rank = np.empty(n)
    rank[order] = np.arange(n)[::-1]  # the nearest is 0
    for i in order:
        first[row[i], column[i]] = rank[i]
    side = splat_px(n, window)
    first = cv2.erode(first, np.ones((side, side), np.uint8)).astype(int)
    by_rank = np.append(order[::-1], n)[first]
    if rgb is not None:
        return np.concatenate([rgb, np.full((1, 3), BACKGROUND)])[by_rank]
    grey = 250 - 190 * (np.append(level, 0)[by_rank].astype(np.float32) / layout.levels)
    return np.repeat(np.where(by_rank == n, BACKGROUND, grey.astype(int))[..., None], 3, axis=2)


@pytest.mark.parametrize("colored", [True, False])
@pytest.mark.parametrize("n", [1, 40, 700, 6000])
def test_pictures_agree_with_those_of_a_plain_loop(n: int, colored: bool) -> None:
    rng = np.random.default_rng(n)
    xyz = rng.normal(size=(3, n)).astype(np.float32) * np.float32([[1], [0.3], [0.6]])
    rgb = rng.integers(0, 255, (n, 3)).astype(np.uint8) if colored else None
    axes = Rotation.random(VIEWS, rng=rng).as_matrix().astype(np.float32)
    along = axes @ xyz
    low, high = along[:, :2].min(axis=2), along[:, :2].max(axis=2)
    windows = fit_windows(low.astype(np.float64), high.astype(np.float64), 64)
    depths = np.stack([along[:, 2].min(axis=1), along[:, 2].max(axis=1)], axis=1)
    pictures = draw_views(xyz, pack_colors(rgb, n), axes, windows, depths)
    for picture, rows, window in zip(pictures, axes, windows, strict=True):
        wanted = reference(xyz, rgb, rows, window)
        assert picture.shape == wanted.shape
        # another order of summation may move a point across the border of a pixel or depth level
        differ = (picture != wanted).any(axis=2).mean()
        assert differ <= 0.002, f"{differ:.2%} of the pixels"


CONFIG = RcvConfig(view_px=96)


def frustum(depth_m: float) -> PointCloud:
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-1, 1) for z in (5.0, 5.0 + depth_m)])
    return PointCloud(corners.astype(np.float32))


@pytest.mark.parametrize(("depth_m", "size_px", "look_px"), [(3.9, 96, 0), (4.1, 224, 224), (60.0, 224, 224)])
def test_a_deep_frustum_is_drawn_and_detected_at_a_larger_size(depth_m: float, size_px: int, look_px: int) -> None:
    cloud = frustum(depth_m)
    assert is_deep(cloud) == (size_px == 224)
    views = plan_step(start(0, Box2D("a", 0.0, 0.0, 9.0, 9.0), cloud, None, CONFIG), CONFIG).views
    assert {(max(view.rgb.shape), view.look_px) for view in views} == {(size_px, look_px)}


UP = np.array([0.0, -1.0, 0.0])


def measure(box: OrientedBox, directions: np.ndarray, noise_m: float = 0.0, seed: int = 0) -> Intervals:
    middle = directions @ box.center_m
    reach = np.abs(directions @ box.rotation) @ box.size_m / 2
    ends = np.stack([middle - reach, middle + reach], axis=1)
    ends = ends + np.random.default_rng(seed).normal(0, 1, ends.shape) * noise_m
    return Intervals(directions, ends, np.full(ends.shape, max(noise_m, 1e-3)))


def box_of(fit) -> OrientedBox:
    return OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m)


def random_box(rng: np.random.Generator, upright: bool) -> OrientedBox:
    size = np.sort(rng.uniform(0.1, 1.0, 3))[::-1] * [1.0, 0.8, 0.6]
    if upright:
        base = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T
        rotation = Rotation.from_rotvec(rng.uniform(0, np.pi) * UP).as_matrix() @ base
    else:
        rotation = Rotation.random(rng=rng).as_matrix()
    return OrientedBox.from_parts(rng.normal(0, 2, 3), rotation, size)


def upright_directions() -> np.ndarray:
    turns = Rotation.from_rotvec(np.arange(4)[:, None] * np.pi / 8 * UP).as_matrix()
    return np.concatenate([turn @ np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]) for turn in turns])


@settings(deadline=None)
@given(seed=st.integers(0, 2**32 - 1), upright=st.booleans())
def test_exact_intervals_give_the_exact_box(seed: int, upright: bool) -> None:
    box = random_box(np.random.default_rng(seed), upright)
    directions = upright_directions() if upright else spread_rotations(12).reshape(-1, 3)
    fit = fit_box(measure(box, directions), UP if upright else None)
    assert fit is not None
    assert iou_3d(box, box_of(fit)) > 0.999
    if upright:
        np.testing.assert_allclose(fit.rotation[:, 2], UP, atol=1e-9)


def test_too_few_intervals_determine_no_box() -> None:
    box = random_box(np.random.default_rng(5), upright=False)
    assert fit_box(measure(box, np.eye(3)), None) is None
    assert fit_box(measure(box, np.eye(3)[:2]), UP) is None


def test_views_along_one_yaw_determine_no_upright_box() -> None:
    """Every rotation fits the intervals along one set of axes equally well; the fit once returned an arbitrary one."""
    for yaw in (0.0, 0.3):
        box = OrientedBox.from_parts(
            np.array([0.0, 0, 5]),
            Rotation.from_rotvec(yaw * UP).as_matrix() @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T,
            np.array([4.0, 1.6, 1.5]),
        )
        assert fit_box(measure(box, np.concatenate([np.eye(3), np.eye(3)])), UP) is None


@pytest.mark.parametrize("upright", [False, True])
def test_several_outlier_intervals_do_not_shift_the_box(upright: bool) -> None:
    """10 % of the ends are outliers and 10 % are unknown; the search and the fit use the others."""
    rng = np.random.default_rng(3)
    box = random_box(rng, upright)
    directions = upright_directions() if upright else spread_rotations(12).reshape(-1, 3)
    intervals = measure(box, directions, 0.001)
    count = len(directions)
    wrong = rng.choice(2 * count, count // 5, replace=False)
    ends, sigma = intervals.ends_m.reshape(-1).copy(), intervals.sigma_m.reshape(-1).copy()
    ends[wrong[1::2]] += rng.choice([-0.2, 0.2], len(wrong[1::2]))
    ends[wrong[1]] += 3.0
    sigma[wrong[::2]] = np.inf
    fit = fit_box(Intervals(directions, ends.reshape(-1, 2), sigma.reshape(-1, 2)), UP if upright else None)
    assert fit is not None
    assert iou_3d(box, box_of(fit)) > 0.98


def true_box(number: int, up: np.ndarray | None) -> OrientedBox:
    rotation = random_box(np.random.default_rng(number), up is not None).rotation
    return OrientedBox.from_parts(np.array([0.1, 0.0, 2.0]), rotation, np.array([0.6, 0.4, 0.3]))


def measured(box: OrientedBox, noise_m: float, up: np.ndarray | None, rng: np.random.Generator) -> Intervals:
    axes = [*wide_axes(up), *near_axes(box.rotation, up)]
    directions = np.concatenate([rows[[0, 1]] for rows in axes] + [rows[[2, 1]] for rows in axes])
    along = box_corners(box) @ directions.T
    ends = np.stack([along.min(axis=0), along.max(axis=0)], axis=1)
    return Intervals(directions, ends + rng.normal(0, noise_m, ends.shape), np.full(ends.shape, noise_m))


def fitted(intervals: Intervals, up: np.ndarray | None) -> BoxFit:
    fit = fit_box(intervals, up)
    assert fit is not None
    return fit


@pytest.mark.parametrize("up", [UP, None], ids=["upright", "free"])
@pytest.mark.parametrize("noise_m", [0.005, 0.02])
def test_independent_errors_lose_as_much_iou_as_expected(
    up: np.ndarray | None, noise_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    expected, lost = [], []
    for number in range(40):
        box = true_box(number, up)
        intervals = measured(box, noise_m, up, rng)
        fit = fitted(intervals, up)
        # here every end is independent of the others
        monkeypatch.setattr(interval_fit, "INDEPENDENT_ENDS", intervals.ends_m.size)
        expected.append(fit.expected_iou_loss())
        lost.append(1 - iou_3d(box, box_of(fit)))
    assert np.mean(expected) == pytest.approx(np.mean(lost), rel=0.25)


def test_repeated_views_do_not_make_a_box_more_certain() -> None:
    box = true_box(3, None)
    intervals = measured(box, 0.01, None, np.random.default_rng(1))
    once = fitted(intervals, None).expected_iou_loss()
    assert fitted(Intervals.concatenate([intervals] * 3), None).expected_iou_loss() == pytest.approx(once, rel=0.05)
