"""Operators' effort per box, by the box's origin, and the quality of proposals, computed from the event log."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, select

from annotator.geometry.iou import iou_3d_pairs
from annotator.geometry.oriented_box import same_box
from annotator.project.adjusting.moving import Moves
from annotator.project.event_types import ImageBoxesState, LabelState, Origin
from annotator.project.events import Effort
from annotator.project.records import BoxRecord, parsed
from annotator.project.schema import AnyRow, events, labels, revertible
from annotator.project.undo_state import IMAGE, LABEL, present_state
from annotator.types import Box2D, ReviewState, Source

DRAFT = "draft-"
PROPOSED_JSON = f'"state":"{ReviewState.PROPOSED.value}"'

UNTOUCHED, CORRECTED, FROM_NOTHING = "proposal accepted untouched", "proposal edited", "from nothing"
PLACED, COPIED, IMPORT_EDITED = "placed in 3D", "copied", "import edited"
ORIGINS = (UNTOUCHED, CORRECTED, FROM_NOTHING, PLACED, COPIED, IMPORT_EDITED)
_MANUAL = {Origin.DRAWN: FROM_NOTHING, Origin.PLACED: PLACED, Origin.COPIED: COPIED, None: FROM_NOTHING}


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


@dataclass(frozen=True)
class ReviewStatistics:
    """Results of the review.

    Attributes:
        effort: cost per box.
        accepted_untouched: share of the reviewed proposals (rejected ones included) that were accepted unchanged.
        iou_proposal_to_final: mean exact 3D IoU between the proposed and the final box, over accepted and edited
            proposals; None without any.
    """

    effort: EffortStatistics
    accepted_untouched: float | None
    iou_proposal_to_final: float | None


def draft_id(frame_id: int, image_box: Box2D) -> str:
    """Id of a draft: an unfinished object without a label. Its effort is counted under this id."""
    edges = ",".join(f"{edge:.3f}" for edge in image_box.xyxy)
    return DRAFT + hashlib.sha256(f"{frame_id}:{edges}".encode()).hexdigest()[:20]


def read_review(connection: Connection) -> ReviewStatistics:
    """Statistics of all reviewed labels and all actions with counted effort."""
    log = _read_log(connection)
    reviewed = [state.value for state in ReviewState if state is not ReviewState.PROPOSED]
    rows = connection.execute(select(labels).where(labels.c.state.in_(reviewed)).order_by(labels.c.id)).all()
    final = [row for row in rows if row.state != ReviewState.REJECTED.value]
    proposals = [row for row in rows if row.proposal_event_id is not None]
    untouched = sum(_origin(row, log.proposed) == UNTOUCHED for row in final)
    return ReviewStatistics(
        _effort(final, log), untouched / len(proposals) if proposals else None, _mean_iou(final, log.proposed)
    )


# --- the log ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _ActionCost:
    """The effort of one action, and the ids of the labels or drafts that it was for."""

    effort: Effort
    targets: tuple[str, ...]


@dataclass
class _EffortLog:
    """The effort that the log records.

    Attributes:
        moves: of the recordings' clouds.
        costs: of all actions with counted effort, in order.
        became: draft id -> uid of the label that it became.
        moved: draft id -> draft id after its box on the image was changed.
        proposed: label uid -> its state as a proposal, for labels that an operator has touched.
    """

    moves: Moves
    costs: list[_ActionCost] = field(default_factory=list)
    became: dict[str, str] = field(default_factory=dict)
    moved: dict[str, str] = field(default_factory=dict)
    proposed: dict[str, LabelState] = field(default_factory=dict)

    def add_action(self, rows: Sequence[AnyRow]) -> None:
        """Adds the events of one action."""
        touched = dict.fromkeys(_uid(row) for row in rows if row.target.startswith(LABEL))
        for row in rows:
            if row.target == IMAGE:
                self._add_image_boxes(row)
            elif row.target.startswith(LABEL):
                self._add_label(row)
        first = rows[0]
        if first.actions is not None:
            targets = (first.effort_target,) if first.effort_target is not None else tuple(touched)
            self.costs.append(_ActionCost(Effort(first.actions, first.seconds), targets))

    def by_label(self) -> dict[str, tuple[float, float]]:
        """Label uid -> actions and seconds; the effort of an action for several labels is divided equally."""
        spent: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        for cost in self.costs:
            for target in cost.targets:
                entry = spent[self._label(target)]
                entry[0] += cost.effort.actions / len(cost.targets)
                entry[1] += cost.effort.seconds / len(cost.targets)
        return {uid: (actions, seconds) for uid, (actions, seconds) in spent.items()}

    def _label(self, target: str) -> str:
        seen = set()
        while target not in self.became and target in self.moved and target not in seen:
            seen.add(target)
            target = self.moved[target]
        return self.became.get(target, target)

    def _add_image_boxes(self, row: AnyRow) -> None:
        """Records a changed box on the image: the draft's id changes with it."""
        if row.before is None or row.after is None:
            return
        before, after = (parsed(ImageBoxesState.model_validate_json, state).boxes for state in (row.before, row.after))
        removed, added = [box for box in before if box not in after], [box for box in after if box not in before]
        if len(removed) == len(added) == 1:
            self.moved[draft_id(row.frame_id, removed[0])] = draft_id(row.frame_id, added[0])

    def _add_label(self, row: AnyRow) -> None:
        uid = _uid(row)
        if row.kind == "label_created" and row.effort_target is not None and row.effort_target.startswith(DRAFT):
            self.became[row.effort_target] = uid
        if uid not in self.proposed and row.before is not None and PROPOSED_JSON in row.before:
            before = present_state(self.moves, row.frame_id, row.target, row.before, row.id)
            self.proposed[uid] = parsed(LabelState.model_validate_json, before or row.before)


def _read_log(connection: Connection) -> _EffortLog:
    query = (
        select(
            events.c.id,
            events.c.frame_id,
            events.c.kind,
            events.c.action,
            events.c.subject.label("effort_target"),
            events.c.actions,
            events.c.seconds,
            revertible.c.subject.label("target"),
            revertible.c.before,
            revertible.c.after,
        )
        .join(revertible, revertible.c.event_id == events.c.id)
        .order_by(events.c.id)
    )
    log = _EffortLog(Moves(connection))
    by_action: dict[str, list[AnyRow]] = defaultdict(list)
    for row in connection.execute(query):
        by_action[row.action].append(row)
    for rows in by_action.values():
        log.add_action(rows)
    return log


def _uid(row: AnyRow) -> str:
    uid: str = row.target.partition(":")[2]
    return uid


# --- the statistics ---------------------------------------------------------------------------------------------------


def _origin(row: AnyRow, proposed: Mapping[str, LabelState]) -> str | None:
    """Origin of a reviewed box; None for an imported one that was not edited."""
    if row.proposal_event_id is not None:
        before = proposed.get(row.uid)
        if before is None:  # reviewed with a version of annotator that did not record actions
            return UNTOUCHED if row.state == ReviewState.ACCEPTED.value else CORRECTED
        return UNTOUCHED if _is_unchanged(row, before) else CORRECTED
    if row.source == Source.IMPORTED.value:
        return IMPORT_EDITED if row.state == ReviewState.EDITED.value else None
    return _MANUAL[None if row.origin is None else Origin(row.origin)]


def _is_unchanged(row: AnyRow, before: LabelState) -> bool:
    """Compares class and box, since an edited label that was accepted afterwards has the state "accepted"."""
    box = parsed(BoxRecord.model_validate_json, row.box)
    return bool(row.label == before.label) and (box == before.box or same_box(box.box(), before.box.box()))


def _effort(rows: Sequence[AnyRow], log: _EffortLog) -> EffortStatistics:
    spent = log.by_label()
    by_origin: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in rows:
        origin = _origin(row, log.proposed)
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


def _mean_iou(rows: Sequence[AnyRow], proposed: Mapping[str, LabelState]) -> float | None:
    pairs = [
        (parsed(BoxRecord.model_validate_json, row.box).box(), proposed[row.uid].box.box())
        for row in rows
        if row.uid in proposed
    ]
    if not pairs:
        return None
    return float(iou_3d_pairs([final for final, _ in pairs], [first for _, first in pairs]).mean())
