"""What a hand can do to a box in Review's three views along its axes, with the hand's error.

An edge moves one face of the box, a corner two, the inside of the rectangle the whole box; the yellow handle turns the
box about the view's depth. A number changes a side of the box about its centre. The hand aims where the box becomes as
near to the true one as this action can make it, but never beyond the picture.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import iou_3d_pairs
from annotator.rcv.axes import with_axes_like
from annotator.types import OrientedBox
from annotator.workflows.workbench.contact_sheet import AXES, MARGIN, Axis
from benchmarks.keystrokes import DRAG_S, number_s

# As on the page: side of a view, and length of the rotation handle's arm, pixels; the shortest side of a box, metres.
VIEW_PX, ARM_PX = 320, 26
MIN_SIZE_M = 0.01
# Decimals and digits of a typed side, metres.
DECIMALS, DIGITS = 2, 4
# Sequences of actions are sought to this length; the best ones of each length go on.
MOST_MOVES, BEAM = 5, 8

Hand = Callable[[], float]
"""Returns the hand's next error, pixels."""


@dataclass(frozen=True, eq=False)
class Move:
    """One action: its kind, its seconds, and what it makes of a box, given the true box and the hand."""

    kind: str
    seconds: float
    apply: Callable[[OrientedBox, OrientedBox, Hand], OrientedBox]


def steady() -> float:
    """A hand without error: where the operator aims."""
    return 0.0


def shaky(rng: np.random.Generator, error_px: float) -> Hand:
    """A hand with a normally distributed error of each coordinate."""
    return lambda: float(rng.normal(0.0, error_px))


def moves() -> list[Move]:
    """All actions in the three views, and the typed sides."""
    return list(_all_moves())


def _all_moves() -> Iterator[Move]:
    for view in AXES:
        right, down = view.right[0], view.down[0]
        for faces in _grips(right, down):
            kind = "drag edge" if len(faces) == 1 else "drag corner"
            yield Move(kind, DRAG_S, _faces_dragged(view, faces))
        yield Move("drag box", DRAG_S, _box_dragged(view))
        yield Move("turn", DRAG_S, _turned(view))
    for axis in range(3):
        yield Move("type number", number_s(DIGITS), _typed(axis))


def _grips(right: int, down: int) -> Iterator[tuple[tuple[int, int], ...]]:
    for sides in product((-1, 0, 1), repeat=2):
        faces = tuple((axis, side) for axis, side in zip((right, down), sides, strict=True) if side)
        if faces:
            yield faces


def plan(box: OrientedBox, truth: OrientedBox, quality: float, known: Sequence[Move]) -> list[Move]:
    """The shortest sequence of actions after which a steady hand reaches a quality; the best one found if none does.

    Args:
        quality: 3D IoU.
        known: `moves()`.
    """
    ways: list[tuple[list[Move], OrientedBox]] = [([], box)]
    best: tuple[float, list[Move]] = (0.0, [])
    for _ in range(MOST_MOVES):
        tried = [([*done, move], move.apply(at, truth, steady)) for done, at in ways for move in known]
        ious = iou_3d_pairs([after for _, after in tried], [truth] * len(tried))
        order = np.argsort(-ious, kind="stable")
        if ious[order[0]] > best[0]:
            best = float(ious[order[0]]), tried[order[0]][0]
        if best[0] >= quality:
            break
        # a turn seldom helps by itself, but what comes after it does
        turns = [way for way in tried if way[0][-1].kind == "turn"]
        ways = [tried[index] for index in order[:BEAM]] + turns[: len(AXES)]
    return best[1]


def _metres_per_px(box: OrientedBox, view: Axis) -> float:
    return float(box.size_m[[view.right[0], view.down[0]]].max()) * (1 + 2 * MARGIN) / VIEW_PX


def _spans(box: OrientedBox, truth: OrientedBox) -> Float64[np.ndarray, "3 2"]:
    """Where the true box ends along the axes of a box, from that box's centre, metres."""
    like = with_axes_like(truth, box)
    middle = box.rotation.T @ (like.center_m - box.center_m)
    return middle[:, None] + np.array([-0.5, 0.5]) * like.size_m[:, None]


def _from_spans(box: OrientedBox, spans_m: Float64[np.ndarray, "3 2"]) -> OrientedBox:
    spans = np.sort(spans_m, axis=1)
    size = np.maximum(spans[:, 1] - spans[:, 0], MIN_SIZE_M)
    return OrientedBox.from_parts(box.center_m + box.rotation @ spans.mean(axis=1), box.rotation, size)


def _own(box: OrientedBox) -> Float64[np.ndarray, "3 2"]:
    return np.array([-0.5, 0.5]) * box.size_m[:, None]


def _faces_dragged(
    view: Axis, faces: Sequence[tuple[int, int]]
) -> Callable[[OrientedBox, OrientedBox, Hand], OrientedBox]:
    def apply(box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
        scale, aim, spans = _metres_per_px(box, view), _spans(box, truth), _own(box)
        reach = scale * VIEW_PX / 2
        for axis, side in faces:
            end = 0 if side < 0 else 1
            spans[axis, end] = np.clip(aim[axis, end], -reach, reach) + scale * hand()
        return _from_spans(box, spans)

    return apply


def _box_dragged(view: Axis) -> Callable[[OrientedBox, OrientedBox, Hand], OrientedBox]:
    def apply(box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
        scale, aim, spans = _metres_per_px(box, view), _spans(box, truth).mean(axis=1), _own(box)
        reach = scale * VIEW_PX / 2
        for axis in (view.right[0], view.down[0]):
            spans[axis] += np.clip(aim[axis], -reach, reach) + scale * hand()
        return _from_spans(box, spans)

    return apply


def _turned(view: Axis) -> Callable[[OrientedBox, OrientedBox, Hand], OrientedBox]:
    down, depth = view.down[0], view.depth[0]
    first, second = (depth + 1) % 3, (depth + 2) % 3

    def apply(box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
        own, like = box.rotation, with_axes_like(truth, box).rotation
        sine = like[:, first] @ own[:, second] - like[:, second] @ own[:, first]
        cosine = like[:, first] @ own[:, first] + like[:, second] @ own[:, second]
        arm_px = box.size_m[down] / _metres_per_px(box, view) / 2 + ARM_PX
        angle = float(np.arctan2(sine, cosine)) + hand() / arm_px
        turned = own.copy()
        turned[:, first] = np.cos(angle) * own[:, first] + np.sin(angle) * own[:, second]
        turned[:, second] = np.cos(angle) * own[:, second] - np.sin(angle) * own[:, first]
        return OrientedBox.from_parts(box.center_m, turned, box.size_m)

    return apply


def _typed(axis: int) -> Callable[[OrientedBox, OrientedBox, Hand], OrientedBox]:
    def apply(box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
        size = box.size_m.copy()
        size[axis] = max(round(float(with_axes_like(truth, box).size_m[axis]), DECIMALS), MIN_SIZE_M)
        return OrientedBox.from_parts(box.center_m, box.rotation, size)

    return apply
