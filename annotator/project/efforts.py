"""Operators' effort per box, by the box's origin."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.types import Box2D

DRAFT = "draft-"

UNTOUCHED, CORRECTED, FROM_NOTHING = "proposal accepted untouched", "proposal edited", "from nothing"
PLACED, COPIED, IMPORT_EDITED = "placed in 3D", "copied", "import edited"
ORIGINS = (UNTOUCHED, CORRECTED, FROM_NOTHING, PLACED, COPIED, IMPORT_EDITED)


class BoxEffort(BaseModel):
    """Mean effort per box; None where no effort was counted.

    Attributes:
        boxes: number of accepted or edited boxes with counted effort.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    boxes: int
    seconds_a_box: float | None
    actions_a_box: float | None


class EffortStatistics(BoxEffort):
    """Effort per box, over all boxes and by origin; every origin is a key, even without boxes."""

    by_origin: dict[str, BoxEffort]


def draft_id(frame_id: int, image_box: Box2D) -> str:
    """Id of a draft: an unfinished object without a label. Its effort is counted under this id."""
    edges = ",".join(f"{edge:.3f}" for edge in image_box.xyxy)
    return DRAFT + hashlib.sha256(f"{frame_id}:{edges}".encode()).hexdigest()[:20]


def effort_of(spent: Sequence[tuple[str, tuple[float, float]]]) -> EffortStatistics:
    """The mean effort of boxes, given as origin, and actions and seconds."""
    by_origin: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for origin, effort in spent:
        by_origin[origin].append(effort)
    parts = {origin: box_effort(by_origin.get(origin, [])) for origin in ORIGINS}
    return EffortStatistics(**box_effort([effort for _, effort in spent]).model_dump(), by_origin=parts)


def box_effort(entries: Sequence[tuple[float, float]]) -> BoxEffort:
    """The mean effort of boxes, given as actions and seconds."""
    if not entries:
        return BoxEffort(boxes=0, seconds_a_box=None, actions_a_box=None)
    return BoxEffort(
        boxes=len(entries),
        seconds_a_box=float(np.mean([seconds for _, seconds in entries])),
        actions_a_box=float(np.mean([actions for actions, _ in entries])),
    )
