"""The pose of a box of known size: exact intervals give the exact box, also if some faces were not measured."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.rcv.config import FitConfig
from annotator.rcv.interval_fit import Intervals
from annotator.rcv.known_size_fit import fit_known_size, traced_intervals
from annotator.types import OrientedBox

SIZE = np.array([0.8, 0.4, 0.3])
UP = np.array([0.0, -1.0, 0.0])


def measured(box: OrientedBox, directions: np.ndarray, noise_m: float = 0.0) -> Intervals:
    reach = 0.5 * np.abs(directions @ box.rotation) @ box.size_m
    middle = directions @ box.center_m
    ends = np.stack([middle - reach, middle + reach], axis=1)
    ends += np.random.default_rng(1).normal(0, noise_m, ends.shape)
    return Intervals(directions, ends, np.full(ends.shape, 0.01))


def start_of(box: OrientedBox, turn: Rotation) -> OrientedBox:
    return OrientedBox.from_parts(box.center_m + np.array([0.1, -0.05, 0.15]), turn.as_matrix() @ box.rotation, SIZE)


@pytest.mark.parametrize("seed", range(5))
def test_exact_intervals_give_the_exact_free_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    box = OrientedBox.from_parts(np.array([0.2, 0.1, 2.0]), Rotation.random(rng=rng).as_matrix(), SIZE)
    directions = rng.standard_normal((12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    start = start_of(box, Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)))
    assert iou_3d(fit_known_size(measured(box, directions), start, None, FitConfig()), box) > 0.93
    assert iou_3d(fit_known_size(measured(box, directions, 0.01), start, None, FitConfig()), box) > 0.85


@pytest.mark.parametrize("turn", [-0.5, 0.0, 0.4])
def test_an_upright_box_with_unmeasured_faces_is_placed_by_the_others(turn: float) -> None:
    upright = Rotation.from_euler("y", 0.3) * Rotation.from_euler("x", np.pi / 2)
    box = OrientedBox.from_parts(np.array([0.2, 0.1, 2.0]), upright.as_matrix(), SIZE)
    angles = np.linspace(0, np.pi, 7)
    directions = np.concatenate([np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1), [UP]])
    intervals = measured(box, directions)
    hidden = Intervals(intervals.directions, intervals.ends_m, intervals.sigma_m.copy())
    hidden.sigma_m[hidden.directions[:, 2] > 0.3, 1] = np.inf  # the far ends
    start = start_of(box, Rotation.from_rotvec(turn * UP))
    fitted = fit_known_size(hidden, start, UP, FitConfig())
    assert iou_3d(fitted, box) > 0.95
    assert fitted.size_m == pytest.approx(SIZE)
    assert np.abs(fitted.rotation[:, 2] @ UP) == pytest.approx(1, abs=1e-6)


def test_one_wrong_measurement_does_not_move_the_box() -> None:
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 2.0]), np.eye(3), SIZE)
    directions = np.concatenate([np.eye(3)] * 4)
    intervals = measured(box, directions)
    intervals.ends_m[4] += 0.5
    assert iou_3d(fit_known_size(intervals, start_of(box, Rotation.identity()), None, FitConfig()), box) > 0.9


def test_a_trace_without_detections_measures_nothing() -> None:
    from annotator.rcv.config import RcvConfig

    assert traced_intervals((), RcvConfig()) is None
