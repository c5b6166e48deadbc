"""Following an object by its points: it is found again, and a box that loses its object says so."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import CAMERA, box_surface, some_box
from scipy.spatial.transform import Rotation

from annotator.geometry.iou import iou_3d
from annotator.rcv.config import Orientation, RcvConfig
from annotator.rcv.follow_object import Followed, FollowStop, Look, follow_object
from annotator.types import Box2D, Frame, Image, OrientedBox, PointCloud
from annotator.workflows.workbench.review_queue import doubt

UP = np.array([0.0, -1.0, 0.0])
UPRIGHT = RcvConfig(orientation=Orientation.UPRIGHT)
# From this doubt on, `benchmarks.follow` counts a box as marked.
MARKED = 0.8


def frame_of(*parts: np.ndarray) -> Frame:
    xyz = np.concatenate(parts).astype(np.float32)
    image = np.zeros((480, 640, 3), np.uint8)
    return Frame("000000", 0, CAMERA, image, PointCloud(xyz, np.full((len(xyz), 3), 99, np.uint8)), up=UP)


def seen(box: OrientedBox, seed: int = 0, points: int = 6000) -> np.ndarray:
    """Points on the sides of an upright box that face the camera, fewer on those seen at a flat angle."""
    rng = np.random.default_rng(seed)
    xyz = box_surface(box, points, rng)
    local = (xyz - box.center_m) @ box.rotation / box.size_m
    axis = np.argmax(np.abs(local), axis=1)
    normal = box.rotation.T[axis] * np.sign(local[np.arange(len(local)), axis])[:, None]
    facing = -(normal * xyz).sum(axis=1) / np.linalg.norm(xyz, axis=1)
    return np.asarray(xyz[facing > rng.random(len(xyz))])


def turned(box: OrientedBox, angle_rad: float, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> OrientedBox:
    turn = Rotation.from_rotvec(angle_rad * UP).as_matrix()
    return OrientedBox.from_parts(box.center_m + np.array(shift), turn @ box.rotation, box.size_m)


BOX = turned(some_box([0.2, 0.1, 3.0], [np.pi / 2, 0.0, 0.0], [0.8, 0.5, 1.2]), 0.4)


def follow(frames: Sequence[Frame], start: OrientedBox = BOX) -> list[Followed]:
    """Follows a box from the first frame on, up to the first frame without it."""
    reviewed = last = Look.of(frames[0].cloud.xyz_m, start)
    results = []
    for frame in frames[1:]:
        followed = follow_object(frame, last.box, reviewed, last, "thing", None, UPRIGHT)
        results.append(followed)
        if followed.proposal is None:
            break
        last = Look.of(frame.cloud.xyz_m, followed.proposal.box, followed.kept)
    return results


def marked(followed: Followed) -> bool:
    assert followed.proposal is not None
    value = doubt(followed.proposal.quality, followed.proposal.score)
    assert value is not None
    return value >= MARKED


def test_a_moving_and_turning_object_keeps_its_size() -> None:
    boxes = [turned(BOX, 0.05 * k, [0.03 * k, 0.0, 0.05 * k]) for k in range(10)]
    results = follow([frame_of(seen(box, k)) for k, box in enumerate(boxes)])
    assert len(results) == 9
    for followed, box in zip(results, boxes[1:], strict=True):
        assert followed.proposal is not None
        assert iou_3d(followed.proposal.box, box) > 0.6
        np.testing.assert_array_equal(followed.proposal.box.size_m, BOX.size_m)
        assert not marked(followed)


def test_an_object_that_turns_its_other_side_is_not_lost() -> None:
    boxes = [turned(BOX, 0.09 * k) for k in range(30)]
    results = follow([frame_of(seen(box, k)) for k, box in enumerate(boxes)])
    last = results[-1].proposal
    assert len(results) == 29
    assert last is not None
    assert iou_3d(last.box, boxes[-1]) > 0.4


def test_an_object_that_jumps_further_than_registration_reaches_is_found() -> None:
    moved = turned(BOX, 0.1, [0.4, -0.2, 0.1])
    (followed,) = follow([frame_of(seen(BOX)), frame_of(seen(moved, 1))])
    assert followed.proposal is not None
    assert iou_3d(followed.proposal.box, moved) > 0.6


def test_neighbours_are_not_confused_with_the_object() -> None:
    neighbour = turned(BOX, -0.2, [0.95, 0.0, 0.2])
    boxes = [turned(BOX, 0.0, [0.02 * k, 0.0, 0.0]) for k in range(8)]
    results = follow([frame_of(seen(box, k), seen(neighbour, 50 + k)) for k, box in enumerate(boxes)])
    assert results[-1].proposal is not None
    assert iou_3d(results[-1].proposal.box, boxes[-1]) > 0.8


def test_a_box_that_loses_its_object_is_marked_and_then_lost() -> None:
    """The object disappears from above, and the bar that it touches stays."""
    bar = box_surface(some_box([1.0, 0.4, 3.0], [0.0, 0.0, 0.0], [2.4, 0.3, 0.3]), 400, np.random.default_rng(1))
    frames = []
    for k in range(20):
        points = seen(BOX, k)
        frames.append(frame_of(bar, points[points[:, 1] > BOX.center_m[1] - 0.6 + 0.06 * k]))
    results = follow(frames)
    assert results[-1].proposal is None
    assert results[-1].stop in (FollowStop.CHANGED, FollowStop.POINTS)
    assert not marked(results[0])
    assert marked(results[-2])


def test_what_is_not_there_is_not_followed() -> None:
    first, elsewhere = frame_of(seen(BOX)), frame_of(seen(turned(BOX, 0.0, [0.0, 0.0, 9.0])))
    assert follow([first, elsewhere])[0].stop is FollowStop.POINTS
    behind = turned(BOX, 0.0, [0.0, 0.0, -9.0])
    (result,) = follow([frame_of(seen(BOX), seen(behind)), first], behind)
    assert result.stop is FollowStop.LEFT


class Measures:
    """A view detector that sees every object larger than its points by a factor."""

    labels, fingerprint = ("thing",), "measures"

    def __init__(self, factor: float) -> None:
        self.factor = factor

    def detect(self, images: Sequence[Image]) -> list[list[Box2D]]:
        return [[self._around(image.rgb)] for image in images]

    def _around(self, rgb: np.ndarray) -> Box2D:
        rows, columns = np.nonzero((rgb != rgb[0, 0]).any(axis=2))
        middle = np.array([columns.min() + columns.max(), rows.min() + rows.max()]) / 2
        half = self.factor * np.array([np.ptp(columns), np.ptp(rows)]) / 2
        return Box2D("thing", *(middle - half).tolist(), *(middle + half).tolist(), 0.9)


@pytest.mark.parametrize(("factor", "is_taken"), [(1.0, True), (0.3, False)])
def test_a_measured_box_is_taken_if_it_agrees(factor: float, is_taken: bool) -> None:
    whole = [box_surface(box, 3000, np.random.default_rng(k)) for k, box in enumerate((BOX, turned(BOX, 0.05)))]
    reviewed = Look.of(whole[0], BOX)
    followed = follow_object(frame_of(whole[1]), BOX, reviewed, reviewed, "thing", Measures(factor), UPRIGHT)
    assert followed.proposal is not None
    assert bool(followed.proposal.trace) is is_taken
    assert iou_3d(followed.proposal.box, turned(BOX, 0.05)) > 0.7
    # its axes are those of the reviewed box
    assert np.trace(followed.proposal.box.rotation.T @ BOX.rotation) > 2.9
