"""The protocols: properties and cases by hand; tests/benchmarks/test_benchmarks_run.py has the official numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.evaluation.boxes import LABELLINGS, BoxTable, evaluate_oriented, pose_errors
from annotator.evaluation.kitti import RELAXED, KittiResult, KittiRows, Metric, evaluate_kitti, score_thresholds
from annotator.types import OrientedBox


def cube(x: float, size: float = 1.0) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.0, 5.0]), np.eye(3), np.full(3, size))


CASES = [
    pytest.param([(0, 0.5)], [0], 1.0, id="found"),
    pytest.param([(9, 0.9), (0, 0.5)], [0], 0.5, id="wrong-one-first"),
    pytest.param([(0, 0.9), (0, 0.8), (5, 0.7)], [0, 5], 0.5 + 1 / 3, id="found-twice"),
]


@pytest.mark.parametrize(("found", "truth", "expected"), CASES)
def test_average_precision_equals_the_value_computed_by_hand(
    found: list[tuple[float, float]], truth: list[float], expected: float
) -> None:
    detections = BoxTable.of([(0, "a", cube(x), score) for x, score in found])
    result = evaluate_oriented(detections, BoxTable.of([(0, "a", cube(x), 1.0) for x in truth]))
    assert result.classes["a"].curves[0.5].area == pytest.approx(expected)


def box(x: float, y: float = 0.0, size: tuple[float, float, float] = (1, 1, 1), turn: Rotation | None = None):
    matrix = np.eye(3) if turn is None else turn.as_matrix()
    return OrientedBox.from_parts(np.array([x, y, 5.0]), matrix, np.array(size, np.float64))


def test_ap_without_detections_is_0_and_without_truth_nan() -> None:
    some, none = BoxTable.of([(0, "a", box(0), 1.0)]), BoxTable.of([])
    assert evaluate_oriented(none, some).mean(0.25) == 0.0
    assert math.isnan(evaluate_oriented(some, none).mean(0.25))
    found = evaluate_oriented(none, some).classes["a"]
    assert (found.mean_iou, found.matched, found.curves[0.5].final_recall) == (0.0, 0, 0.0)
    assert math.isnan(found.rotation_error_rad)


def test_the_assignment_maximises_the_total_iou() -> None:
    """The first detection overlaps two true boxes; each detection gets one, and the mean counts both."""
    truth = BoxTable.of([(0, "a", box(0.0), 1.0), (0, "a", box(0.6), 1.0), (0, "a", box(50.0), 1.0)])
    found = BoxTable.of([(0, "a", box(0.2), 0.9), (0, "a", box(0.0), 0.8)])
    result = evaluate_oriented(found, truth).classes["a"]
    assert result.mean_iou == pytest.approx((1.0 + 0.6 / 1.4) / 3)
    assert (result.objects, result.matched) == (3, 2)


def one(x: float, size: tuple[float, float, float], turn: Rotation) -> BoxTable:
    return BoxTable.of([(0, "a", box(x, size=size, turn=turn), 1.0)])


TURN = Rotation.from_rotvec([0.3, -0.8, 0.5])
QUARTER, HALF, TENTH = (Rotation.from_rotvec([0, 0, angle]) for angle in (math.pi / 2, math.pi, 0.1))
POSES = [
    pytest.param((1, 2, 3), (1, 2, 3), TURN, 0.0, 0.0, id="the-same"),
    pytest.param((1, 2, 3), (1, 2, 3), TURN * TENTH, 0.1, 0.0, id="turned"),
    pytest.param((1, 2, 3), (1, 2, 3), TURN * HALF * TENTH, 0.1, 0.0, id="half-turn"),
    pytest.param((1, 2, 3), (2, 1, 3), TURN * QUARTER, 0.0, 0.0, id="length-and-width-swapped"),
    pytest.param((1, 2, 3), (1, 2, 3), TURN * QUARTER, math.pi / 2, 0.0, id="a-quarter-turn-of-a-long-box"),
    pytest.param(
        (1, 1.05, 3),
        (1, 1.05, 3),
        TURN * QUARTER,
        0.0,
        0.05 / 1.05 / 3 + 0.05 / 3,
        id="a-quarter-turn-of-a-nearly-square-box",
    ),
    pytest.param((1, 2, 4), (1.1, 2, 4), TURN, 0.0, 0.1 / 3, id="longer"),
]


@pytest.mark.parametrize(("true_size", "size", "turn", "rotation_rad", "size_error"), POSES)
def test_pose_errors_ignore_symmetries_of_the_box(true_size, size, turn, rotation_rad, size_error) -> None:
    errors = pose_errors(one(0.5, size, turn), one(0.0, true_size, TURN))
    assert errors.center_m[0] == pytest.approx(0.5)
    assert errors.rotation_rad[0] == pytest.approx(rotation_rad, abs=1e-7)
    assert errors.size[0] == pytest.approx(size_error, abs=1e-7)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.integers(0, 23))
def test_the_labelling_of_the_axes_has_no_effect(seed: int, naming: int) -> None:
    rng = np.random.default_rng(seed)
    turns, sizes = Rotation.random(2, rng=rng).as_matrix(), rng.uniform(0.2, 2.0, (2, 3))
    a, b = (
        BoxTable.of([(0, "a", OrientedBox.from_parts(np.zeros(3), turn, size), 1.0)])
        for turn, size in zip(turns, sizes, strict=True)
    )
    name = LABELLINGS[naming]
    renamed = OrientedBox.from_parts(np.zeros(3), turns[0] @ name, np.abs(name).T @ sizes[0])
    before, after = pose_errors(a, b), pose_errors(BoxTable.of([(0, "a", renamed, 1.0)]), b)
    assert after.rotation_rad[0] == pytest.approx(before.rotation_rad[0], abs=1e-7)
    assert 0 <= before.rotation_rad[0] <= 2 * math.pi / 3 + 1e-7, "one of the symmetric rotations is within 120 degrees"


@dataclass(frozen=True)
class Box:
    """A row; the 3D box is that of a car by default."""

    label: str
    edges: tuple[float, float, float, float]
    score: float = 1.0
    truncated: float = 0.0
    occluded: int = 0
    alpha: float = 0.0
    size: tuple[float, float, float] = (1.5, 1.6, 4.0)
    bottom: tuple[float, float, float] = (0.0, 1.5, 20.0)
    rotation_y: float = 0.0

    def moved(self, **changes: object) -> Box:
        return replace(self, **changes)


Frame = list[Box]


def columns(frames: list[Frame]) -> KittiRows:
    """The boxes as the evaluation's input."""
    rows = [(number, box) for number, frame in enumerate(frames) for box in frame]
    numbers = [[b.truncated, b.occluded, b.alpha, *b.edges, *b.size, *b.bottom, b.rotation_y, b.score] for _, b in rows]
    return KittiRows.from_table(
        np.array([number for number, _ in rows], np.int64),
        np.array([box.label for _, box in rows], np.str_),
        np.array(numbers, np.float64).reshape(-1, 15),
    )


EASY = 0
CAR = Box("Car", (100, 100, 200, 150))
FAR = (600.0, 100.0, 700.0, 150.0)


def evaluated(found: list[Frame], truth: list[Frame]) -> KittiResult:
    return evaluate_kitti(columns(found), columns(truth))


def bbox(found: Frame, truth: Frame, level: int = EASY) -> tuple[int, int, float]:
    """For one frame with cars: the number that count, the number found, and the best precision."""
    curve = evaluated([found], [truth])["Car"][Metric.BBOX][level]
    return curve.objects, curve.found, float(curve.samples[0])


SMALL = CAR.moved(edges=(100, 100, 200, 139.9))
BY_HAND = [
    pytest.param([CAR.moved(label="CAR")], [CAR], (1, 1, 1.0), id="case-is-ignored"),
    pytest.param([CAR, CAR], [CAR], (1, 1, 0.5), id="found-twice"),
    pytest.param([CAR, CAR.moved(edges=FAR)], [CAR, CAR.moved(label="Van", edges=FAR)], (1, 1, 1.0), id="on-a-van"),
    pytest.param([CAR, CAR.moved(edges=FAR)], [CAR, CAR.moved(label="Truck", edges=FAR)], (1, 1, 0.5), id="on-a-truck"),
    pytest.param([CAR, CAR.moved(edges=FAR)], [CAR, CAR.moved(edges=FAR, occluded=1)], (1, 1, 1.0), id="on-a-hard-one"),
    pytest.param(
        [CAR, CAR.moved(edges=FAR)],
        [CAR, Box("DontCare", (500, 0, 900, 300), truncated=-1, occluded=-1)],
        (1, 1, 1.0),
        id="in-a-dontcare-area-much-larger",
    ),
    pytest.param(
        [CAR, CAR.moved(edges=FAR)],
        [CAR, Box("DontCare", (500, 0, 669, 300), truncated=-1, occluded=-1)],
        (1, 1, 0.5),
        id="too-little-overlap-with-a-dontcare-area",
    ),
    pytest.param([CAR, SMALL.moved(edges=(600, 100, 700, 139))], [CAR], (1, 1, 1.0), id="too-small-to-be-false"),
    pytest.param([SMALL, CAR.moved(edges=FAR)], [CAR], (1, 0, 0.0), id="matched-by-a-small-one"),
    pytest.param(
        [CAR.moved(score=0.5), SMALL.moved(label="Pedestrian")], [CAR], (1, 0, 0.0), id="a-small-one-of-another-class"
    ),
    pytest.param([CAR], [CAR.moved(edges=(100, 100, 200, 140))], (0, 0, 0.0), id="truth-at-the-height-limit"),
    pytest.param(
        [CAR.moved(edges=(100, 100, 200, 140))],
        [CAR.moved(edges=(100, 100, 200, 141))],
        (1, 1, 1.0),
        id="detection-at-the-height-limit",
    ),
]


@pytest.mark.parametrize(("found", "truth", "expected"), BY_HAND)
def test_matches_and_precision_equal_those_computed_by_hand(
    found: Frame, truth: Frame, expected: tuple[int, int, float]
) -> None:
    assert bbox(found, truth) == pytest.approx(expected)


def test_metrics_without_values_are_missing() -> None:
    unknown = {"size": (-1.0, -1.0, -1.0), "bottom": (-1000.0, -1000.0, -1000.0)}
    curves = evaluated([[CAR.moved(**unknown)]], [[CAR]])
    assert list(curves) == ["Car"]
    assert set(curves["Car"]) == {Metric.BBOX, Metric.AOS}
    no_angle = evaluated([[CAR], [Box("DontCare", FAR, alpha=-10.0)]], [[CAR], []])["Car"]
    assert set(no_angle) == {Metric.BBOX, Metric.BEV, Metric.BOX_3D}
    no_image = evaluated([[CAR.moved(edges=(-1, -1, -1, -1))]], [[CAR]])["Car"]
    assert set(no_image) == {Metric.BEV, Metric.BOX_3D}
    assert no_image[Metric.BOX_3D][EASY].found == 0, "a box without a height is ignored in all metrics"
    assert evaluated([[]], [[CAR]]) == {}
    assert evaluated([], []) == {}


def test_bev_and_3d_use_their_own_overlaps() -> None:
    """A car of 4 x 1.6 m that is shifted by 1 m along its length has a BEV IoU of 3/5."""
    ahead = CAR.moved(bottom=(1.0, 1.5, 20.0))
    turned = CAR.moved(rotation_y=math.pi / 2)
    pairs = {"ahead": (ahead, CAR), "turned": (ahead.moved(rotation_y=math.pi), CAR), "crossed": (turned, CAR)}
    found = {
        name: {m: c[EASY].found for m, c in evaluate_kitti(columns([[a]]), columns([[b]]), RELAXED)["Car"].items()}
        for name, (a, b) in pairs.items()
    }
    assert found["ahead"] == found["turned"] == {Metric.BBOX: 1, Metric.AOS: 1, Metric.BEV: 1, Metric.BOX_3D: 1}
    assert found["crossed"] == {Metric.BBOX: 1, Metric.AOS: 1, Metric.BEV: 0, Metric.BOX_3D: 0}
    lower = CAR.moved(bottom=(0.0, 2.1, 20.0))
    result = evaluate_kitti(columns([[lower]]), columns([[CAR]]), RELAXED)["Car"]
    assert (result[Metric.BEV][EASY].found, result[Metric.BOX_3D][EASY].found) == (1, 0), "0.9 of 2.1 m is below a half"


def test_dontcare_areas_affect_only_the_image_metric() -> None:
    truth = [[CAR, Box("DontCare", (500, 0, 900, 300), size=(-1, -1, -1), bottom=(-1000, -1000, -1000))]]
    found = [[CAR, CAR.moved(edges=FAR, bottom=(20.0, 1.5, 20.0))]]
    curves = evaluated(found, truth)["Car"]
    assert [float(curves[m][EASY].samples[0]) for m in (Metric.BBOX, Metric.BEV, Metric.BOX_3D)] == [1.0, 0.5, 0.5]


def test_boxes_match_only_within_their_frame_and_class() -> None:
    truth = BoxTable.of([(0, "a", box(0), 1.0), (1, "b", box(0), 1.0)])
    found = BoxTable.of([(1, "a", box(0), 1.0), (0, "b", box(0), 1.0), (0, "c", box(0), 1.0), (7, "a", box(0), 1.0)])
    classes = evaluate_oriented(found, truth).classes
    assert {label: (one.curves[0.25].area, one.detections) for label, one in classes.items()} == {
        "a": (0.0, 2),
        "b": (0.0, 1),
    }


def test_thresholds_are_those_nearest_to_41_recalls() -> None:
    assert score_thresholds(np.array([0.2, 0.9, 0.5]), 3).tolist() == [0.9, 0.5, 0.2], "fewer objects than samples"
    chosen = score_thresholds(np.arange(400, 0, -1.0), 400)
    assert (len(chosen), chosen[0], chosen[-1]) == (41, 400.0, 1.0)
    np.testing.assert_allclose(np.diff(chosen)[1:-1], -10)
