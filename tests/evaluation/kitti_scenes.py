"""Small KITTI scenes, and a reference implementation of the benchmark: one frame, one threshold, one box at a time.

It follows the devkit's readme and its known pitfalls, and uses none of the code under test, so that a
misunderstanding in one of the two shows as a difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from annotator.evaluation.kitti import KittiRows

LIMITS = ((40, 0, 0.15), (25, 1, 0.30), (25, 2, 0.50))
NEIGHBOUR = {"car": "van", "pedestrian": "person_sitting", "cyclist": None}


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


def iou(a: Box, b: Box) -> float:
    inner = intersection(a, b)
    return inner / (area(a) + area(b) - inner) if inner > 0 else 0.0


def intersection(a: Box, b: Box) -> float:
    width = min(a.edges[2], b.edges[2]) - max(a.edges[0], b.edges[0])
    height = min(a.edges[3], b.edges[3]) - max(a.edges[1], b.edges[1])
    return width * height if width > 0 and height > 0 else 0.0


def area(a: Box) -> float:
    return (a.edges[2] - a.edges[0]) * (a.edges[3] - a.edges[1])


def height(a: Box) -> float:
    return a.edges[3] - a.edges[1]


@dataclass
class Counted:
    """One frame at one threshold."""

    right: list[tuple[float, float]]
    wrong: int
    missed: int


def truth_role(box: Box, label: str, level: int) -> int:
    """0: counts; 1: ignored; -1: not considered."""
    own = box.label.lower() == label
    if not own:
        return 1 if box.label.lower() == NEIGHBOUR[label] else -1
    least, occlusion, truncation = LIMITS[level]
    return int(box.occluded > occlusion or box.truncated > truncation or height(box) <= least)


def found_role(box: Box, label: str, level: int) -> int:
    """0: counts; 1: ignored (too small, any class); -1: not considered."""
    if height(box) < LIMITS[level][0]:
        return 1
    return 0 if box.label.lower() == label else -1


def count(found: Frame, truth: Frame, label: str, level: int, needed: float, threshold: float | None) -> Counted:
    """The greedy assignment: the highest score wins without a threshold, the largest overlap with one."""
    roles = [found_role(box, label, level) for box in found]
    free = [r >= 0 and (threshold is None or box.score >= threshold) for r, box in zip(roles, found, strict=True)]
    valid = [index for index, is_free in enumerate(free) if is_free and roles[index] == 0]
    result = Counted([], 0, 0)
    for true in truth:
        role = truth_role(true, label, level)
        fits = [i for i, is_free in enumerate(free) if is_free and iou(found[i], true) > needed]
        if role < 0:
            continue
        if not fits:
            result.missed += role == 0
            continue
        if threshold is None:
            taken = max(fits, key=lambda i: (found[i].score, -i))
        else:
            taken = max(fits, key=lambda i: (roles[i] == 0, iou(found[i], true) if roles[i] == 0 else 0.0, -i))
        free[taken] = False
        if role == 0 and roles[taken] == 0:
            result.right.append((found[taken].score, (1 + math.cos(true.alpha - found[taken].alpha)) / 2))
    areas = [true for true in truth if true.label.lower() == "dontcare"]
    for index in valid:
        if free[index]:
            box = found[index]
            result.wrong += not any(intersection(box, a) / area(box) > needed for a in areas)
    return result


def samples(found: list[Frame], truth: list[Frame], label: str, level: int, needed: float) -> tuple[list, list]:
    """The 41 samples of precision and of orientation similarity."""
    frames = list(zip(found, truth, strict=True))
    first = [score for f, t in frames for score, _ in count(f, t, label, level, needed, None).right]
    objects = sum(truth_role(box, label, level) == 0 for t in truth for box in t)
    precision, similarity = [], []
    for threshold in thresholds(sorted(first, reverse=True), objects):
        counted = [count(f, t, label, level, needed, threshold) for f, t in frames]
        right = [entry for c in counted for entry in c.right]
        total = len(right) + sum(c.wrong for c in counted)
        precision.append(len(right) / total if total else 0.0)
        similarity.append(sum(s for _, s in right) / total if total else 0.0)
    pad = [0.0] * (41 - len(precision))
    best = [[max(values[i:]) for i in range(len(values))] + pad for values in (precision, similarity)]
    return best[0], best[1]


def thresholds(scores: list[float], objects: int) -> list[float]:
    """Skips a score if the next one is nearer to the wanted recall."""
    chosen, wanted = [], 0.0
    for index, score in enumerate(scores):
        this, following = (index + 1) / objects, (index + 2) / objects
        if index + 1 < len(scores) and following - wanted < wanted - this:
            continue
        chosen.append(score)
        wanted += 1 / 40
    return chosen
