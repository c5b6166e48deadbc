"""What a box costs in other tools, walked through from what they publish about themselves.

Each tool gives a first box, and then offers actions in its views along the box's axes. The walk begins with the most
favourable first box: the camera needs no turn, the true heading and the class are found at once, and a fit to the
points finds all of the object's and no others. From there, `review_moves.plan` finds the shortest way with the tool's
actions, by the same hand, with the same looks. Frames are labelled one by one. Left out are the interpolation and
tracking that some of them have, and the ways between frames.

- SUSTechPOINTS (doc/operations.md of its repository): Ctrl and a drag around the object fit a box to its points. In
  three views along its axes, borders, corners and the box are dragged, and keys turn it.
- CVAT (its manual, "3D Object annotation"): after three clicks (tool, class, shape), a double-click places a cube near
  the points, here of 1 m. In three views it is moved, its corners are dragged, and a point turns it.
- labelCloud (README of its repository): after a click, four picked points span the length, width and height of what is
  seen. Sides are moved with the wheel above them, the box is moved and turned with keys.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import aligned_box
from annotator.types import OrientedBox
from benchmarks.keystrokes import CLICK_S, DRAG_S, KEY_S, Bill, P
from benchmarks.review_moves import Hand, Move, moves, plan

# Side of CVAT's first cube, metres. Keys or notches of the wheel for one correction in labelCloud, at least.
CUBE_M, STEPS = 1.0, 5
MOST_ACTIONS = 20


@dataclass(frozen=True)
class Tool:
    """A tool: the first actions with their seconds, whether they fit the box to points, and the actions it offers.

    Attributes:
        seconds: of an action, by kind, where it is no drag.
    """

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


def peers(objects: Iterable[Seen], quality: float, hand: Hand) -> dict[str, dict[str, Any]]:
    """Draws objects with each tool; returns the figures by tool."""
    seen = list(objects)
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
