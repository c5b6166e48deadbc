"""What a hand can do to a box in Review's three views along its axes, with the hand's error.

An edge moves one face of the box, a corner two, the inside of the rectangle the whole box; the yellow handle turns the
box about the view's depth. A number changes a side of the box about its centre. The hand aims where the box becomes as
near to the true one as this action can make it, but never beyond the picture.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float64

from annotator.geometry.iou import iou_3d, iou_3d_matrix
from annotator.geometry.oriented_box import aligned_box
from annotator.rcv.axes import with_axes_like
from annotator.types import OrientedBox
from annotator.workflows.workbench.contact_sheet import AXES, MARGIN, Axis

# The keystroke-level model: how long an expert takes for a routine task that is done without errors.
#
# The operators' times are those of S. K. Card, T. P. Moran and A. Newell, "The keystroke-level model for user
# performance time with interactive systems", Communications of the ACM 23(7), 1980, pp. 396-410; that of a mouse button
# is from D. Kieras, "Using the keystroke-level model to estimate execution times", University of Michigan, 2001. The
# model knows neither tired operators nor slips.
#
# The left hand stays on the keyboard and the right one on the mouse, as the pages of annotation tools are used; only a
# number that is typed takes the right hand to the keyboard and back.
# K: one key, by a person who types 40 words a minute. P: pointing with the mouse. B: pressing or releasing its button.
# H: moving a hand between mouse and keyboard. M: preparing mentally, here one look at what the page shows. Seconds.
K, P, B, H, M = 0.28, 1.10, 0.10, 0.40, 1.35

KEY_S = K
# A key with Shift or Ctrl: the paper counts these as keystrokes of their own.
CHORD_S = 2 * K
CLICK_S = P + 2 * B
# Also with Ctrl.
SHIFT_CLICK_S = K + CLICK_S
DRAG_S = 2 * (P + B)


@dataclass
class Bill:
    """What an operator has done.

    Attributes:
        actions: number of keys, clicks, drags and typed numbers, by what they did; one for several tracks is divided.
        looks: number of looks at the page.
        hands_s: seconds of the hands.
        waiting_s: measured seconds of waiting for the program.
    """

    actions: defaultdict[str, Fraction] = field(default_factory=lambda: defaultdict(Fraction))
    looks: int = 0
    hands_s: float = 0.0
    waiting_s: float = 0.0

    @property
    def seconds(self) -> float:
        """All seconds."""
        return self.hands_s + M * self.looks + self.waiting_s

    @property
    def count(self) -> float:
        """Number of all actions."""
        return float(sum(self.actions.values()))

    @property
    def by_kind(self) -> dict[str, float]:
        """Number of actions by what they did, the most frequent first."""
        ordered = sorted(self.actions.items(), key=lambda entry: -entry[1])
        return {kind: int(times) if times.denominator == 1 else float(times) for kind, times in ordered}

    def act(self, kind: str, seconds: float, among: int = 1) -> None:
        """Counts one action, which `among` so many bills share."""
        self.actions[kind] += Fraction(1, among)
        self.hands_s += seconds / among

    def __add__(self, other: Bill) -> Bill:
        actions = defaultdict(Fraction, self.actions)
        for kind, times in other.actions.items():
            actions[kind] += times
        hands_s, waiting_s = self.hands_s + other.hands_s, self.waiting_s + other.waiting_s
        return Bill(actions, self.looks + other.looks, hands_s, waiting_s)


# As on the page: side of a view, and length of the rotation handle's arm, pixels; the shortest side of a box, metres.
VIEW_PX, ARM_PX = 320, 26
MIN_SIZE_M = 0.01
# Decimals and digits of a typed side, metres.
DECIMALS, DIGITS = 2, 4
# Seconds to click into a number's field, type it and press Enter.
TYPE_S = CLICK_S + 2 * H + (DIGITS + 1) * K
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


def shaky(rng: np.random.Generator, error_px: float) -> Hand:
    """A hand with a normally distributed error of each coordinate."""
    return lambda: float(rng.normal(0.0, error_px))


def moves() -> list[Move]:
    """All actions in the three views, and the typed sides."""
    known = []
    for view in AXES:
        for sides in product((-1, 0, 1), repeat=2):
            faces = [(axis, side) for axis, side in zip((view.right[0], view.down[0]), sides, strict=True) if side]
            if faces:
                kind = "drag edge" if len(faces) == 1 else "drag corner"
                known.append(Move(kind, DRAG_S, partial(_drag_faces, view, faces)))
        known.append(Move("drag box", DRAG_S, partial(_drag_box, view)))
        known.append(Move("turn", DRAG_S, partial(_turn, view)))
    return known + [Move("type number", TYPE_S, partial(_type_side, axis)) for axis in range(3)]


def plan(box: OrientedBox, truth: OrientedBox, quality: float, known: Sequence[Move]) -> list[Move]:
    """The shortest sequence of known actions after which a steady hand reaches a quality (3D IoU), or the best one."""
    ways: list[tuple[list[Move], OrientedBox]] = [([], box)]
    best: tuple[float, list[Move]] = (0.0, [])
    for _ in range(MOST_MOVES):
        tried = [([*done, move], move.apply(at, truth, lambda: 0.0)) for done, at in ways for move in known]
        ious = iou_3d_matrix([after for _, after in tried], [truth])[:, 0]
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


def _drag_faces(
    view: Axis, faces: Sequence[tuple[int, int]], box: OrientedBox, truth: OrientedBox, hand: Hand
) -> OrientedBox:
    scale, aim, spans = _metres_per_px(box, view), _spans(box, truth), _own(box)
    reach = scale * VIEW_PX / 2
    for axis, side in faces:
        end = 0 if side < 0 else 1
        spans[axis, end] = np.clip(aim[axis, end], -reach, reach) + scale * hand()
    return _from_spans(box, spans)


def _drag_box(view: Axis, box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
    scale, aim, spans = _metres_per_px(box, view), _spans(box, truth).mean(axis=1), _own(box)
    reach = scale * VIEW_PX / 2
    for axis in (view.right[0], view.down[0]):
        spans[axis] += np.clip(aim[axis], -reach, reach) + scale * hand()
    return _from_spans(box, spans)


def _turn(view: Axis, box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
    down, depth = view.down[0], view.depth[0]
    first, second = (depth + 1) % 3, (depth + 2) % 3
    own, like = box.rotation, with_axes_like(truth, box).rotation
    sine = like[:, first] @ own[:, second] - like[:, second] @ own[:, first]
    cosine = like[:, first] @ own[:, first] + like[:, second] @ own[:, second]
    arm_px = box.size_m[down] / _metres_per_px(box, view) / 2 + ARM_PX
    angle = float(np.arctan2(sine, cosine)) + hand() / arm_px
    turned = own.copy()
    turned[:, first] = np.cos(angle) * own[:, first] + np.sin(angle) * own[:, second]
    turned[:, second] = np.cos(angle) * own[:, second] - np.sin(angle) * own[:, first]
    return OrientedBox.from_parts(box.center_m, turned, box.size_m)


def _type_side(axis: int, box: OrientedBox, truth: OrientedBox, hand: Hand) -> OrientedBox:
    size = box.size_m.copy()
    size[axis] = max(round(float(with_axes_like(truth, box).size_m[axis]), DECIMALS), MIN_SIZE_M)
    return OrientedBox.from_parts(box.center_m, box.rotation, size)


# What a box costs in other tools, walked through from what they publish about themselves.
#
# Each tool gives a first box, and then offers actions in its views along the box's axes. The walk begins with the most
# favourable first box: the camera needs no turn, the true heading and the class are found at once, and a fit to the
# points finds all of the object's and no others. From there, `plan` finds the shortest way with the tool's
# actions, by the same hand, with the same looks. Frames are labelled one by one. Left out are the interpolation and
# tracking that some of them have, and the ways between frames.
#
# - SUSTechPOINTS (doc/operations.md of its repository): Ctrl and a drag around the object fit a box to its points. In
#   three views along its axes, borders, corners and the box are dragged, and keys turn it.
# - CVAT (its manual, "3D Object annotation"): after three clicks (tool, class, shape), a double-click places a cube
#   near the points, here of 1 m. In three views it is moved, its corners are dragged, and a point turns it.
# - labelCloud (README of its repository): after a click, four picked points span the length, width and height of what
#   is seen. Sides are moved with the wheel above them, the box is moved and turned with keys.

# Side of CVAT's first cube, metres. Keys or notches of the wheel for one correction in labelCloud, at least.
CUBE_M, STEPS = 1.0, 5
MOST_ACTIONS = 20


@dataclass(frozen=True)
class Tool:
    """A tool: the first actions with their seconds, whether they fit the box to points, and the actions it offers, with
    the seconds of those that are no drags."""

    first: tuple[tuple[str, float], ...]
    fits: bool
    offers: frozenset[str]
    seconds: dict[str, float]


TOOLS = {
    "SUSTechPOINTS": Tool(
        (("draw", KEY_S + DRAG_S),),
        True,
        frozenset({"drag edge", "drag corner", "drag box", "turn"}),
        {"turn": STEPS * KEY_S},
    ),
    "CVAT": Tool(
        (("click", CLICK_S),) * 3 + (("place", CLICK_S + 2 * (CLICK_S - P) / 2),),
        False,
        frozenset({"drag corner", "drag box", "turn"}),
        {},
    ),
    "labelCloud": Tool(
        (("click", CLICK_S),) * 5,
        True,
        frozenset({"drag edge", "drag box", "turn"}),
        {"drag edge": P + STEPS * KEY_S, "drag box": 2 * STEPS * KEY_S, "turn": STEPS * KEY_S},
    ),
}

Seen = tuple[OrientedBox, np.ndarray]
"""A true box, and the points inside it, (n, 3)."""


def peers(seen: Sequence[Seen], quality: float, hand: Hand) -> dict[str, dict[str, Any]]:
    """Draws objects with each tool; returns the figures by tool."""
    result = {}
    for name, tool in TOOLS.items():
        offered = [
            Move(move.kind, tool.seconds.get(move.kind, move.seconds), move.apply)
            for move in moves()
            if move.kind in tool.offers
        ]
        bill, missed = Bill(), 0
        for truth, xyz_m in seen:
            missed += not _draw(tool, truth, xyz_m, offered, quality, hand, bill)
        result[name] = {
            "boxes": len(seen),
            "actions_per_box": bill.count / max(len(seen), 1),
            "seconds_per_box": bill.seconds / max(len(seen), 1),
            "by_kind": bill.by_kind,
            "failures": missed / max(len(seen), 1),
        }
    return result


def _draw(
    tool: Tool, truth: OrientedBox, xyz_m: np.ndarray, offered: Sequence[Move], quality: float, hand: Hand, bill: Bill
) -> bool:
    """Draws one object; returns whether its box is right."""
    bill.looks += 1
    for kind, seconds in tool.first:
        bill.act(kind, seconds)
    size_m = np.full(3, CUBE_M)
    fitted = aligned_box(xyz_m, truth.rotation)
    box = fitted if tool.fits else OrientedBox.from_parts(fitted.center_m, truth.rotation, size_m)
    bill.looks += 1
    for _ in range(MOST_ACTIONS):
        if iou_3d(box, truth) >= quality:
            return True
        (move, *_) = plan(box, truth, quality, offered)
        bill.act(move.kind, move.seconds)
        box = move.apply(box, truth, hand)
        bill.looks += 1
    return iou_3d(box, truth) >= quality
