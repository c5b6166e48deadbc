"""KITTI's protocol: against a reference implementation, by properties, and on cases computed by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kitti_scenes import Box, Frame, columns, samples

from annotator.evaluation.kitti import OFFICIAL, RELAXED, KittiResult, Metric, evaluate_kitti, score_thresholds

EASY = 0
CAR = Box("Car", (100, 100, 200, 150))
FAR = (600.0, 100.0, 700.0, 150.0)


def evaluated(found: list[Frame], truth: list[Frame]) -> KittiResult:
    return evaluate_kitti(columns(found), columns(truth))


def bbox(found: Frame, truth: Frame, level: int = EASY) -> tuple[int, int, float]:
    """For one frame with cars: the number that count, the number found, and the best precision."""
    curve = evaluated([found], [truth]).curves["Car"][Metric.BBOX][level]
    return curve.objects, curve.found, float(curve.samples[0])


side = st.integers(0, 3).map(lambda v: 20.0 * v)
height = st.sampled_from([20.0, 25.0, 30.0, 40.0, 44.0, 50.0])


@st.composite
def row(draw: st.DrawFn, labels: tuple[str, ...]) -> Box:
    x, y = draw(side), draw(side)
    return Box(
        draw(st.sampled_from(labels)),
        (x, y, x + draw(st.sampled_from([40.0, 60.0])), y + draw(height)),
        score=draw(st.sampled_from([-1.5, 0.0, 0.2, 0.5, 0.9])),
        truncated=draw(st.sampled_from([0.0, 0.15, 0.2, 0.4])),
        occluded=draw(st.integers(0, 3)),
        alpha=draw(st.sampled_from([0.0, 1.0, math.pi])),
    )


found_frames = st.lists(row(("Car", "car", "Pedestrian", "Van", "DontCare")), max_size=6)
true_frames = st.lists(row(("Car", "Van", "Pedestrian", "Person_sitting", "DontCare", "Truck")), max_size=6)


@settings(max_examples=30)
@given(st.lists(st.tuples(found_frames, true_frames), min_size=1, max_size=3))
def test_the_evaluation_agrees_with_the_reference_implementation(frames: list[tuple[Frame, Frame]]) -> None:
    """Crowded scenes full of ties: equal scores, equal overlaps, boxes within boxes, heights at the limits."""
    found, truth = [f for f, _ in frames], [t for _, t in frames]
    result = evaluated(found, truth)
    present = {box.label.lower() for frame in found for box in frame}
    assert set(result.curves) == {name for name in ("Car", "Pedestrian", "Cyclist") if name.lower() in present}
    for label, curves in result.curves.items():
        for level in range(3):
            needed = OFFICIAL.bbox[label]
            precision, similarity = samples(found, truth, label.lower(), level, needed)
            np.testing.assert_allclose(curves[Metric.BBOX][level].samples, precision, atol=1e-12)
            np.testing.assert_allclose(curves[Metric.AOS][level].samples, similarity, atol=1e-12)


SMALL = CAR.moved(edges=(100, 100, 200, 139.9))
BY_HAND = [
    pytest.param([CAR], [CAR], (1, 1, 1.0), id="found"),
    pytest.param([CAR.moved(edges=FAR)], [CAR], (1, 0, 0.0), id="missed"),
    pytest.param([CAR.moved(label="CAR")], [CAR], (1, 1, 1.0), id="case-is-ignored"),
    pytest.param([CAR, CAR], [CAR], (1, 1, 0.5), id="found-twice"),
    pytest.param([CAR, CAR.moved(score=0.5)], [CAR], (1, 1, 1.0), id="found-twice-the-second-with-a-lower-score"),
    pytest.param([CAR, CAR.moved(edges=FAR)], [CAR], (1, 1, 0.5), id="one-of-two-is-false"),
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


def test_thresholds_are_those_nearest_to_the_recalls() -> None:
    assert score_thresholds(np.array([0.2, 0.9, 0.5]), 3).tolist() == [0.9, 0.5, 0.2], "fewer objects than samples"
    assert score_thresholds(np.zeros(0), 3).tolist() == []
    scores = np.arange(400, 0, -1.0)
    chosen = score_thresholds(scores, 400)
    assert len(chosen) == 41
    np.testing.assert_allclose(np.diff(chosen)[1:-1], -10)
    assert (chosen[0], chosen[-1]) == (400.0, 1.0)
    assert len(score_thresholds(scores[:200], 400)) == 21, "up to a recall of one half"


def test_metrics_without_values_are_missing() -> None:
    unknown = {"size": (-1.0, -1.0, -1.0), "bottom": (-1000.0, -1000.0, -1000.0)}
    curves = evaluated([[CAR.moved(**unknown)]], [[CAR]]).curves
    assert list(curves) == ["Car"]
    assert set(curves["Car"]) == {Metric.BBOX, Metric.AOS}
    no_angle = evaluated([[CAR], [Box("DontCare", FAR, alpha=-10.0)]], [[CAR], []]).curves["Car"]
    assert set(no_angle) == {Metric.BBOX, Metric.BEV, Metric.BOX_3D}
    no_image = evaluated([[CAR.moved(edges=(-1, -1, -1, -1))]], [[CAR]]).curves["Car"]
    assert set(no_image) == {Metric.BEV, Metric.BOX_3D}
    assert no_image[Metric.BOX_3D][EASY].found == 0, "a box without a height is ignored in all metrics"
    assert evaluated([[]], [[CAR]]).curves == {}
    assert evaluated([], []).curves == {}


def test_bev_and_3d_use_their_own_overlaps() -> None:
    """A car of 4 x 1.6 m that is shifted by 1 m along its length has a BEV IoU of 3/5."""
    ahead = CAR.moved(bottom=(1.0, 1.5, 20.0))
    turned = CAR.moved(rotation_y=math.pi / 2)
    pairs = {"ahead": (ahead, CAR), "turned": (ahead.moved(rotation_y=math.pi), CAR), "crossed": (turned, CAR)}
    found = {
        name: {
            m: c[EASY].found for m, c in evaluate_kitti(columns([[a]]), columns([[b]]), RELAXED).curves["Car"].items()
        }
        for name, (a, b) in pairs.items()
    }
    assert found["ahead"] == found["turned"] == {Metric.BBOX: 1, Metric.AOS: 1, Metric.BEV: 1, Metric.BOX_3D: 1}
    assert found["crossed"] == {Metric.BBOX: 1, Metric.AOS: 1, Metric.BEV: 0, Metric.BOX_3D: 0}
    lower = CAR.moved(bottom=(0.0, 2.1, 20.0))
    result = evaluate_kitti(columns([[lower]]), columns([[CAR]]), RELAXED).curves["Car"]
    assert (result[Metric.BEV][EASY].found, result[Metric.BOX_3D][EASY].found) == (1, 0), "0.9 of 2.1 m is below a half"


def test_dontcare_areas_affect_only_the_image_metric() -> None:
    truth = [[CAR, Box("DontCare", (500, 0, 900, 300), size=(-1, -1, -1), bottom=(-1000, -1000, -1000))]]
    found = [[CAR, CAR.moved(edges=FAR, bottom=(20.0, 1.5, 20.0))]]
    curves = evaluated(found, truth).curves["Car"]
    assert [float(curves[m][EASY].samples[0]) for m in (Metric.BBOX, Metric.BEV, Metric.BOX_3D)] == [1.0, 0.5, 0.5]
