"""What a box costs, by where it came from, and how good the proposals were."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, select

from annotator.geometry.iou import iou_3d_pairs
from annotator.project.efforts import Efforts, read_efforts
from annotator.project.payloads import LabelState, Origin
from annotator.project.records import BoxRecord
from annotator.project.schema import AnyRow, labels
from annotator.types import ReviewState, Source

UNTOUCHED, CORRECTED, FROM_NOTHING = "proposal accepted untouched", "proposal edited", "from nothing"
PLACED, COPIED, IMPORT_EDITED = "placed in 3D", "copied", "import edited"
ORIGINS = (UNTOUCHED, CORRECTED, FROM_NOTHING, PLACED, COPIED, IMPORT_EDITED)
_MADE = {Origin.DRAWN: FROM_NOTHING, Origin.PLACED: PLACED, Origin.COPIED: COPIED, None: FROM_NOTHING}


class BoxEffort(BaseModel):
    """What boxes have cost; None where none was counted.

    Attributes:
        boxes: accepted or edited ones whose effort was counted.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    boxes: int
    seconds_a_box: float | None
    actions_a_box: float | None


class EffortStatistics(BoxEffort):
    """The same by where the boxes came from; every origin is named, also with none."""

    by_origin: dict[str, BoxEffort]


@dataclass(frozen=True)
class ReviewStatistics:
    """What came of the review.

    Attributes:
        effort: what a box costs.
        accepted_untouched: share of the reviewed proposals (rejected ones included) that were accepted as they were.
        iou_proposal_to_final: mean exact 3D IoU of accepted and edited proposals with what they were; None without any.
    """

    effort: EffortStatistics
    accepted_untouched: float | None
    iou_proposal_to_final: float | None


def read_review(connection: Connection) -> ReviewStatistics:
    """Looks at every reviewed label and every counted action."""
    efforts = read_efforts(connection)
    reviewed = [state.value for state in ReviewState if state is not ReviewState.PROPOSED]
    rows = connection.execute(select(labels).where(labels.c.state.in_(reviewed)).order_by(labels.c.id)).all()
    kept = [row for row in rows if row.state != ReviewState.REJECTED.value]
    proposals = [row for row in rows if row.proposal_event_id is not None]
    untouched = sum(_origin(row, efforts) == UNTOUCHED for row in kept)
    return ReviewStatistics(
        _effort(kept, efforts), untouched / len(proposals) if proposals else None, _mean_iou(kept, efforts)
    )


def _origin(row: AnyRow, efforts: Efforts) -> str | None:
    """Where a reviewed box came from; None for one that was imported and left as it was."""
    if row.proposal_event_id is not None:
        before = efforts.proposed.get(row.uid)
        if before is None:  # reviewed before there were actions
            return UNTOUCHED if row.state == ReviewState.ACCEPTED.value else CORRECTED
        return UNTOUCHED if _is_unchanged(row, before) else CORRECTED
    if row.source == Source.IMPORTED.value:
        return IMPORT_EDITED if row.state == ReviewState.EDITED.value else None
    return _MADE[None if row.origin is None else Origin(row.origin)]


def _is_unchanged(row: AnyRow, before: LabelState) -> bool:
    """An edited label that was accepted afterwards is \"accepted\", too: what it is now decides."""
    same: bool = row.label == before.label and BoxRecord.model_validate_json(row.box) == before.box
    return same


def _effort(kept: Sequence[AnyRow], efforts: Efforts) -> EffortStatistics:
    spent = efforts.by_label()
    by_origin: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in kept:
        origin = _origin(row, efforts)
        if origin is not None and row.uid in spent:
            by_origin[origin].append(spent[row.uid])
    everything = [entry for entries in by_origin.values() for entry in entries]
    parts = {origin: _box_effort(by_origin.get(origin, [])) for origin in ORIGINS}
    return EffortStatistics(**_box_effort(everything).model_dump(), by_origin=parts)


def _box_effort(entries: Sequence[tuple[float, float]]) -> BoxEffort:
    if not entries:
        return BoxEffort(boxes=0, seconds_a_box=None, actions_a_box=None)
    return BoxEffort(
        boxes=len(entries),
        seconds_a_box=float(np.mean([seconds for _, seconds in entries])),
        actions_a_box=float(np.mean([actions for actions, _ in entries])),
    )


def _mean_iou(kept: Sequence[AnyRow], efforts: Efforts) -> float | None:
    pairs = [
        (BoxRecord.model_validate_json(row.box).box(), efforts.proposed[row.uid].box.box())
        for row in kept
        if row.uid in efforts.proposed
    ]
    if not pairs:
        return None
    return float(iou_3d_pairs([final for final, _ in pairs], [first for _, first in pairs]).mean())
