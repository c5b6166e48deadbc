"""Linking of boxes into tracks, track ids, boxes at one place, and smoothing."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.tracking.common_size import SizedBox, common_size
from annotator.tracking.link import Seen, frame_times, link, numbered, overlap_at_place
from annotator.tracking.smooth import FLIP, TrackBox, between, relabelled, relabellings, smoothed
from annotator.types import OrientedBox
from annotator.types.errors import GeometryError

SIZE = (0.8, 0.6, 1.8)


def at(x_m: float, z_m: float = 5.0, size_m: tuple[float, float, float] = SIZE) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x_m, 0.0, z_m]), np.eye(3), np.array(size_m))


def seen(x_m: float, z_m: float = 5.0, label: str = "person", given: int | None = None) -> Seen:
    return Seen(label, at(x_m, z_m), given)


def linked(frames: list[list[Seen]], times: list[float] | None = None) -> list[list[tuple[int, int]]]:
    found = link(frames, times or [float(n) for n in range(len(frames))])
    assert sorted(member for track in found for member in track.members) == [
        (place, number) for place, boxes in enumerate(frames) for number in range(len(boxes))
    ], "every box belongs to exactly one object"
    return [track.members for track in found]


def test_two_people_whose_paths_cross_keep_their_tracks() -> None:
    # they meet between frames 4 and 5, where the nearest box of the previous frame is the other person's
    frames = [[seen(-1.5 + 0.33 * n), seen(1.5 - 0.33 * n, 5.05)] for n in range(10)]
    shuffled = [list(reversed(boxes)) if n % 2 else boxes for n, boxes in enumerate(frames)]
    first, second = linked(shuffled)
    assert first == [(n, n % 2) for n in range(10)]
    assert second == [(n, 1 - n % 2) for n in range(10)]


def test_an_object_is_linked_across_a_gap_at_its_predicted_position() -> None:
    gone = (4, 5, 6)
    frames = [[] if n in gone else [seen(0.5 * n)] for n in range(11)]
    assert len(linked(frames)) == 1
    # a box far from the predicted position is another object, even if it is as near to the last position
    back = [[] if n in gone else [seen(0.5 * (n if n < 4 else 6 - n))] for n in range(11)]
    assert len(linked(back)) == 2
    too_long = [[seen(0.0)] if n in (0, 1, 2, 12, 13) else [] for n in range(14)]
    assert len(linked(too_long)) == 2


def test_dropped_frames_are_considered_by_their_times() -> None:
    second_ns = 10**9
    times_ns = [0, second_ns, 2 * second_ns, 3 * second_ns, 6 * second_ns, 7 * second_ns]
    times = frame_times(times_ns)
    assert times.tolist() == [0, 1, 2, 3, 6, 7]
    frames = [[seen(0.5 * time)] for time in times]
    assert len(linked(frames, times.tolist())) == 1
    assert len(linked(frames)) == 2, "with frame numbers alone, the object moves too far"
    assert frame_times([5, 4, 7]).tolist() == [0, 1, 2]
    assert frame_times([5, None, 7]).tolist() == [0, 1, 2]
    assert frame_times([1_700_000_000_000_000_001, 1_700_000_000_000_000_004]).tolist() == [0, 1]


def test_boxes_of_other_classes_sizes_and_positions_are_not_linked() -> None:
    assert len(linked([[seen(0.0)], [seen(0.0, label="car")]])) == 2
    assert len(linked([[seen(0.0)], [Seen("person", at(0.0, size_m=(5.0, 1.8, 1.5)))]])) == 2
    assert len(linked([[seen(0.0)], [seen(3.0)]])) == 2
    # a permutation of the axes has no effect
    assert len(linked([[seen(0.0)], [Seen("person", at(0.0, size_m=(1.8, 0.8, 0.6)))]])) == 1


def test_given_ids_take_precedence_over_costs() -> None:
    # the same id, although the object jumped and another box is at its former position
    frames = [[seen(0.0, given=7), seen(4.0)], [seen(0.0), seen(4.0, given=7)], [seen(0.0), seen(4.0)]]
    by_id = {track.given: track.members for track in link(frames, [0.0, 1.0, 2.0])}
    assert by_id[7][:2] == [(0, 0), (1, 1)]
    # different ids, although they are at the same position
    assert len(linked([[seen(0.0, given=1)], [seen(0.0, given=2)]])) == 2
    # an id given twice in a frame is kept
    assert len(linked([[seen(0.0, given=1), seen(3.0, given=1)], [seen(0.0, given=1)]])) == 1
    # an id that is given later also applies to earlier boxes
    (track,) = link([[seen(0.0)], [seen(0.1)], [seen(0.2, given=5)]], [0.0, 1.0, 2.0])
    assert track.given == 5


@pytest.mark.parametrize(
    ("given", "before", "wanted"),
    [
        ([None, None], [[], []], [1, 2]),
        ([None, 4], [[], [9]], [5, 4]),
        ([None, None], [[3, 3, 1], [3, 1]], [3, 1]),
        ([None, None], [[3], [3]], [3, 4]),
        ([3, None], [[], [3]], [3, 4]),
        ([-2, None], [[], []], [-2, 1]),
        ([2, 2, None], [[2], [2], [2]], [3, 4, 5]),
    ],
)
def test_track_ids_are_kept_where_possible(given: list[int | None], before: list[list[int]], wanted: list[int]) -> None:
    assert numbered(given, before) == wanted
    # applied again, nothing changes
    assert numbered(given, [[number] for number in wanted]) == wanted


CAR = (4.0, 1.0, 1.5)


def box(x: float = 0.0, size_m: tuple[float, float, float] = CAR, turn_deg: float = 0.0) -> OrientedBox:
    rotation = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    return OrientedBox.from_parts(np.array([x, 0.0, 0.0]), rotation, np.array(size_m))


@pytest.mark.parametrize(
    ("other", "overlap"),
    [
        (box(), 1.0),
        (box(2.0), 1 / 3),
        (box(2.2), 0.0),
        (box(turn_deg=90.0), 1 / 7),
        (box(0.2, (0.5, 0.5, 0.5)), 0.125 / 6),
        # its centre is in the car, but not the other way round: another object that touches it
        (box(1.0, (0.5, 0.5, 0.5)), 0.0),
        (box(9.0), 0.0),
    ],
    ids=["same", "a third", "less", "turned", "a part", "beside its centre", "elsewhere"],
)
def test_boxes_at_the_same_place(other: OrientedBox, overlap: float) -> None:
    assert overlap_at_place([box(), box(20.0)], [other]) == pytest.approx(np.array([[overlap], [0.0]]))
    assert overlap_at_place([other], [box()]) == pytest.approx(np.array([[overlap]]))


# columns: the length, width and height axes of an upright box that faces away from the camera
STANDING = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def car(n: float, yaw_deg: float = 0.0, size_m: tuple[float, float, float] = (4.2, 1.8, 1.5)) -> OrientedBox:
    """A car that drives away, rotated about its up axis."""
    turn = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    return OrientedBox.from_parts(np.array([1.0, 0.8, 8.0 + 0.6 * n]), STANDING @ turn, np.array(size_m))


def heading(box: OrientedBox) -> np.ndarray:
    return box.rotation[:, 0]


def test_flipped_headings_are_corrected_by_the_motion() -> None:
    rng = np.random.default_rng(3)
    true = [car(n, 2.0 * n) for n in range(12)]
    noisy = []
    for box in true:
        size = box.size_m * (1 + 0.05 * rng.standard_normal(3))
        turn = Rotation.from_rotvec([0, 0, 0.03 * rng.standard_normal()]).as_matrix()
        found = OrientedBox.from_parts(box.center_m, box.rotation @ turn, size)
        noisy.append(relabelled(found, FLIP) if rng.random() < 0.7 else found)
    assert sum(heading(box) @ heading(own) < 0 for box, own in zip(noisy, true, strict=True)) > 6
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(noisy)])
    assert all(heading(box) @ heading(own) > 0.99 for box, own in zip(better, true, strict=True))
    assert len({tuple(box.size_m) for box in better}) == 1
    driven = smoothed([TrackBox(float(n), box) for n, box in enumerate(noisy)], is_still=False)
    assert all(heading(box) @ heading(own) < -0.99 for box, own in zip(driven, true, strict=True)), "the majority"
    before, after = (np.mean([iou_3d(b, t) for b, t in zip(boxes, true, strict=True)]) for boxes in (noisy, better))
    assert after > before + 0.02


def test_a_size_that_changes_over_time_is_not_averaged() -> None:
    strides = [0.7 + 0.3 * np.sin(0.5 * n) for n in range(20)]
    boxes = [car(0.1 * n, 0.0, (2.0, length, 1.5 + 0.02 * (-1) ** n)) for n, length in enumerate(strides)]
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(boxes)])
    # a constant length would have a mean error of 0.19
    assert np.mean(np.abs(np.array([box.size_m[1] for box in better]) - strides)) < 0.04
    assert len({box.size_m[2] for box in better}) == 1, "a size with independent noise becomes constant"


def test_reviewed_boxes_are_kept_and_set_the_heading_of_the_others() -> None:
    # a reviewed box says that the car drives backwards
    boxes = [car(n, 0.0, (4.0 + 0.1 * n, 1.8, 1.5)) for n in range(6)]
    fixed = relabelled(car(3, 0.0, (4.1, 1.7, 1.5)), FLIP)
    track = [TrackBox(float(n), fixed if n == 3 else box, is_fixed=n == 3) for n, box in enumerate(boxes)]
    better = smoothed(track)
    assert better[3] is fixed
    assert all(heading(box) @ heading(fixed) > 0.999 for box in better)
    assert all(box.size_m[1] == pytest.approx(1.8) and 4.0 <= box.size_m[0] <= 4.2 for box in better[:3])


@settings(max_examples=10, deadline=None)
@given(st.lists(st.integers(0, 23), min_size=5, max_size=5), st.integers(0, 2**31))
def test_permuted_axes_have_no_effect(places: list[int], seed: int) -> None:
    """A freely rotating box with a random permutation of its axes in each frame."""
    start = Rotation.random(rng=np.random.default_rng(seed))
    turns = [start * Rotation.from_rotvec([0.05 * n, 0.08 * n, 0.0]) for n in range(5)]
    true = [OrientedBox.from_parts(np.ones(3), turn.as_matrix(), np.array([0.2, 0.1, 0.05])) for turn in turns]
    other = [relabelled(box, relabellings(False)[place]) for box, place in zip(true, places, strict=True)]
    better = smoothed([TrackBox(float(n), box) for n, box in enumerate(other)])
    # a uniform rotation is not treated as noise, and every box keeps its position
    assert min(iou_3d(a, b) for a, b in zip(better, true, strict=True)) > 0.999
    turned = [(a.T_camera_box.rotation.inv() * b.T_camera_box.rotation).magnitude() for a, b in pairwise(better)]
    assert max(turned) < 0.12


def surface(size_m: np.ndarray, *faces: tuple[int, int]) -> np.ndarray:
    """Points on sides of a box: of an axis, the one before (-1) or behind (1) its middle."""
    random, parts = np.random.default_rng(0), []
    for axis, side in faces:
        points = random.uniform(-0.5, 0.5, (400, 3)) * size_m
        points[:, axis] = side * size_m[axis] / 2
        parts.append(points)
    return np.concatenate(parts)


def test_a_size_is_that_of_the_frames_that_see_the_side_and_no_hidden_side_pulls_it() -> None:
    size_m, turn = np.array([4.5, 1.8, 1.5]), Rotation.from_euler("xyz", (0.2, 0.4, 0.1)).as_matrix()
    boxes, place = [], np.array([3.0, 1.0, 20.0])
    # from behind, a box is as short as what is seen; from the side, as narrow; once both are seen
    for faces, own_m, middle_m in (
        ([(0, -1)], (1.0, 1.8, 1.5), (-1.75, 0.0, 0.0)),
        ([(1, 1)], (4.5, 0.6, 1.5), (0.0, 0.6, 0.0)),
        ([(0, -1), (1, 1)], (4.5, 1.8, 1.5), (0.0, 0.0, 0.0)),
    ):
        box = OrientedBox.from_parts(place + turn @ np.array(middle_m), turn, np.array(own_m))
        boxes.append(SizedBox.of(box, (surface(size_m, *faces) @ turn.T + place).astype(np.float32)))
    np.testing.assert_allclose(common_size(boxes), size_m, rtol=0.03)
    # without points, the boxes tell
    plain = [SizedBox.of(OrientedBox.from_parts(place, turn, s * size_m), np.zeros((0, 3))) for s in (0.9, 1.1)]
    np.testing.assert_allclose(common_size(plain), size_m)


def test_position_size_and_rotation_are_interpolated_linearly() -> None:
    first, last = car(0, 0.0), relabelled(car(10, 40.0, (4.6, 1.8, 1.5)), FLIP)
    found = between(first, last, 2.0, 12.0, [4.5, 7.0, 9.5])
    assert np.allclose([box.center_m for box in found], [car(n).center_m for n in (2.5, 5, 7.5)])
    assert np.allclose([box.size_m[0] for box in found], [4.3, 4.4, 4.5])
    assert all(
        iou_3d(box, car(n, 4.0 * n, (4.2 + 0.04 * n, 1.8, 1.5))) > 0.999
        for box, n in zip(found, (2.5, 5, 7.5), strict=True)
    )
    with pytest.raises(GeometryError, match="between the two"):
        between(first, last, 2.0, 12.0, [12.0])
