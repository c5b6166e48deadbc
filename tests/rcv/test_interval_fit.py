"""The consensus fit: exact intervals give the exact box, noisy ones an approximate box, too few no box."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners
from annotator.rcv import interval_fit
from annotator.rcv.interval_fit import BoxFit, Intervals, fit_box
from annotator.rcv.rotations import near_axes, spread_rotations, wide_axes
from annotator.types import OrientedBox

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
