"""The compiled drawing, compared with plain numpy and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.rcv.config import ViewConfig
from annotator.rcv.pseudo_view import BACKGROUND, KeyLayout, draw_views, fit_windows, pack_colors, splat_px

VIEWS = 3


def reference(xyz, rgb, axes, window, largest_splat_px):
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
    side = splat_px(n, window, largest_splat_px)
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
    config = ViewConfig(size_px=64)
    windows = fit_windows(
        along[:, :2].min(axis=2).astype(np.float64), along[:, :2].max(axis=2).astype(np.float64), config
    )
    depths = np.stack([along[:, 2].min(axis=1), along[:, 2].max(axis=1)], axis=1)
    pictures = draw_views(xyz, pack_colors(rgb, n), axes, windows, depths, config.max_splat_px)
    for picture, rows, window in zip(pictures, axes, windows, strict=True):
        wanted = reference(xyz, rgb, rows, window, config.max_splat_px)
        assert picture.shape == wanted.shape
        # another order of summation may move a point across the border of a pixel or depth level
        differ = (picture != wanted).any(axis=2).mean()
        assert differ <= 0.002, f"{differ:.2%} of the pixels"


def test_points_outside_a_window_are_drawn_at_its_border() -> None:
    (window,) = fit_windows(np.array([[-1.0, -1.0]]), np.array([[1.0, 1.0]]), ViewConfig(size_px=32))
    xyz = np.array([[50.0, -50], [-50, 50], [2, 1]], np.float32)
    packed = pack_colors(np.array([[1, 2, 3], [4, 5, 6]], np.uint8), 2)
    (picture,) = draw_views(xyz, packed, np.eye(3, dtype=np.float32)[None], [window], np.array([[1.5, 1.5]]), 1)
    assert tuple(picture[0, -1]) == (1, 2, 3)
    assert tuple(picture[-1, 0]) == (4, 5, 6)
