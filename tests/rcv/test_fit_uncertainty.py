"""The expected IoU loss of a fitted box, compared with simulated errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import box_corners
from annotator.rcv import interval_fit
from annotator.rcv.config import RcvConfig
from annotator.rcv.interval_fit import BoxFit, Intervals, expected_iou_loss, fit_box
from annotator.rcv.rotations import near_axes, wide_axes
from annotator.types import OrientedBox

UP = np.array([0.0, -1.0, 0.0])
SIZE_M = np.array([0.6, 0.4, 0.3])


def true_box(number: int, up: np.ndarray | None) -> OrientedBox:
    if up is None:
        rotation = Rotation.random(random_state=number).as_matrix()
    else:
        turned = Rotation.from_rotvec(number * up).as_matrix()
        rotation = turned @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return OrientedBox.from_parts(np.array([0.1, 0.0, 2.0]), rotation, SIZE_M)


def measured(box: OrientedBox, noise_m: float, up: np.ndarray | None, rng: np.random.Generator) -> Intervals:
    axes = [*wide_axes(up, RcvConfig()), *near_axes(box.rotation, up, RcvConfig())]
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
        lost.append(1 - iou_3d(box, OrientedBox.from_parts(fit.center_m, fit.rotation, fit.size_m)))
    assert np.mean(expected) == pytest.approx(np.mean(lost), rel=0.25)


def test_repeated_views_do_not_make_a_box_more_certain() -> None:
    box = true_box(3, None)
    intervals = measured(box, 0.01, None, np.random.default_rng(1))
    once = fitted(intervals, None).expected_iou_loss()
    assert fitted(Intervals.concatenate([intervals] * 3), None).expected_iou_loss() == pytest.approx(once, rel=0.05)


def test_a_face_that_is_hardly_measured_makes_the_box_less_certain() -> None:
    box = true_box(5, UP)
    intervals = measured(box, 0.01, UP, np.random.default_rng(2))
    hidden = intervals.directions @ box.rotation[:, 0] > 0.3
    sigma = intervals.sigma_m.copy()
    sigma[hidden, 1] = np.inf
    sigma[intervals.directions @ box.rotation[:, 0] < -0.3, 0] = np.inf
    fit, whole = fit_box(replace(intervals, sigma_m=sigma), UP), fitted(intervals, UP)
    assert fit is not None
    assert fit.expected_iou_loss() > 1.2 * whole.expected_iou_loss()


def test_the_loss_is_between_zero_and_one() -> None:
    box = true_box(1, UP)
    exact = measured(box, 0.0, UP, np.random.default_rng(0))
    exact = replace(exact, sigma_m=np.full_like(exact.ends_m, 0.01))
    assert 0 <= fitted(exact, UP).expected_iou_loss() < 0.01
    directions = exact.directions
    weights = np.full((len(directions), 2), 1e-6)
    assert expected_iou_loss(directions, weights, box.rotation, box.size_m, True) == 1.0
