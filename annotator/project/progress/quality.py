"""How good the proposals were: as they were, against what they became, by class and by distance."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.project.progress.action_log import UNTOUCHED
from annotator.project.progress.reviewed import ReviewedBox

# Distances from the camera, metres: from a hand in front of a camera to a car before a LiDAR.
RANGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 70.0, 100.0)


class Quality(BaseModel):
    """Counts of reviewed boxes, and the quality of their proposals.

    Attributes:
        untouched, corrected, rejected: proposals.
        missed: boxes that no proposal offered.
        iou_proposal_to_final: mean exact 3D IoU of untouched and corrected proposals with what they became; None
            without any.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    untouched: int
    corrected: int
    rejected: int
    missed: int
    iou_proposal_to_final: float | None


class RangeQuality(Quality):
    """Quality from one distance to the next.

    Attributes:
        from_m, to_m: distance of the boxes' centres from the camera; None = any greater one.
    """

    from_m: float
    to_m: float | None


class ProposalQuality(BaseModel):
    """Quality of the proposals; classes are those of the reviewed boxes, and distances without boxes are left out."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    by_class: dict[str, Quality]
    by_range: tuple[RangeQuality, ...]
    by_class_and_range: dict[str, tuple[RangeQuality, ...]]


def quality_of(boxes: Sequence[ReviewedBox]) -> ProposalQuality:
    """The quality of the proposals of all reviewed boxes, those without a review (unchanged imports) left out."""
    by_class: dict[str, list[ReviewedBox]] = defaultdict(list)
    for box in boxes:
        if box.was_proposed or box.origin is not None:
            by_class[box.label].append(box)
    classes = sorted(by_class)
    return ProposalQuality(
        by_class={name: Quality(**_numbers(by_class[name])) for name in classes},
        by_range=_by_range(box for name in classes for box in by_class[name]),
        by_class_and_range={name: _by_range(by_class[name]) for name in classes},
    )


def _by_range(boxes: Iterable[ReviewedBox]) -> tuple[RangeQuality, ...]:
    found: dict[int, list[ReviewedBox]] = defaultdict(list)
    for box in boxes:
        found[bisect_right(RANGES_M, box.range_m) - 1].append(box)
    ends = (*RANGES_M[1:], None)
    return tuple(RangeQuality(from_m=RANGES_M[n], to_m=ends[n], **_numbers(found[n])) for n in sorted(found))


def _numbers(boxes: Sequence[ReviewedBox]) -> dict[str, int | float | None]:
    proposed = [box for box in boxes if box.was_proposed]
    kept = [box for box in proposed if not box.is_rejected]
    untouched = sum(box.origin == UNTOUCHED for box in kept)
    ious = [box.iou for box in kept if box.iou is not None]
    return {
        "untouched": untouched,
        "corrected": len(kept) - untouched,
        "rejected": len(proposed) - len(kept),
        "missed": len(boxes) - len(proposed),
        "iou_proposal_to_final": float(np.mean(ious)) if ious else None,
    }
