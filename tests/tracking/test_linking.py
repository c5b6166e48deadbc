"""Linking of boxes into tracks, and track ids."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.tracking.link import Seen, Track, TrackingConfig, frame_times, link, numbered, predicted
from annotator.types import OrientedBox

CONFIG = TrackingConfig()
SIZE = (0.8, 0.6, 1.8)


def at(x_m: float, z_m: float = 5.0, size_m: tuple[float, float, float] = SIZE) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x_m, 0.0, z_m]), np.eye(3), np.array(size_m))


def seen(x_m: float, z_m: float = 5.0, label: str = "person", given: int | None = None) -> Seen:
    return Seen(label, at(x_m, z_m), given)


def linked(frames: list[list[Seen]], times: list[float] | None = None) -> list[list[tuple[int, int]]]:
    found = link(frames, times or [float(n) for n in range(len(frames))], CONFIG)
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
    by_id = {track.given: track.members for track in link(frames, [0.0, 1.0, 2.0], CONFIG)}
    assert by_id[7][:2] == [(0, 0), (1, 1)]
    # different ids, although they are at the same position
    assert len(linked([[seen(0.0, given=1)], [seen(0.0, given=2)]])) == 2
    # an id given twice in a frame is kept
    assert len(linked([[seen(0.0, given=1), seen(3.0, given=1)], [seen(0.0, given=1)]])) == 1
    # an id that is given later also applies to earlier boxes
    (track,) = link([[seen(0.0)], [seen(0.1)], [seen(0.2, given=5)]], [0.0, 1.0, 2.0], CONFIG)
    assert track.given == 5


def test_motion_is_extrapolated_linearly_from_the_last_boxes() -> None:
    boxes = [at(0.0, 5.0), at(0.5, 4.9), at(1.0, 4.8)]
    assert np.allclose(predicted(boxes, [0.0, 1.0, 2.0], 4.0).center_m, [2.0, 0.0, 4.6])
    assert np.allclose(predicted(boxes[:1], [3.0], 9.0).center_m, boxes[0].center_m)


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


def test_frames_without_boxes_have_no_tracks() -> None:
    assert link([[], []], [0.0, 1.0], CONFIG) == []
    assert isinstance(link([[seen(0.0)]], [0.0], CONFIG)[0], Track)
