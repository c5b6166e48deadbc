"""The operators' actions and what they cost, read from the event log, and their effort per box by its origin."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection, select

from annotator.project.audit.events import Effort, Event, RowChange, event_of
from annotator.project.database.schema import events
from annotator.project.records import BOXES_2D, parsed
from annotator.types import Box2D, ReviewState

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


KEPT, REJECTED = "kept", "rejected"


@dataclass(slots=True)
class Action:
    """One action of an operator.

    Attributes:
        time_ns: of its first event.
        effort: None if it was not counted.
        subject: uid of the label or id of the draft that the effort was for, if given.
        labels: uids of the changed labels, each once.
        frames: the changed frames, each once.
    """

    author: str
    time_ns: int
    effort: Effort | None
    subject: str | None
    labels: dict[str, None] = field(default_factory=dict)
    frames: dict[int, None] = field(default_factory=dict)


@dataclass
class ActionLog:
    """All actions, and what they did to labels.

    Attributes:
        actions: by id, in order.
        proposed: uids of the labels that an operator has reviewed as proposals.
        first: (label uid, "box" or "class_id") -> what an action has changed first.
        decided: (label uid, KEPT or REJECTED) -> author and time (ns) of the decision.
    """

    actions: dict[str, Action] = field(default_factory=dict)
    proposed: set[str] = field(default_factory=set)
    first: dict[tuple[str, str], Any] = field(default_factory=dict)
    decided: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)
    _became: dict[str, str] = field(default_factory=dict)
    _moved: dict[str, str] = field(default_factory=dict)

    def add(self, event: Event) -> None:
        """Adds one event of an action."""
        assert event.action is not None and event.frame_id is not None  # as every action
        action = self.actions.get(event.action)
        if action is None:
            action = Action(event.author, event.time_ns, event.effort, event.effort_target)
            self.actions[event.action] = action
        action.frames[event.frame_id] = None
        for row in event.rows:
            if row.table == "image_labels":
                self._add_image_boxes(event.frame_id, row)
            elif row.table == "labels":
                uid = str(row.key)
                action.labels[uid] = None
                subject = event.effort_target
                if event.kind == "label_created" and subject is not None and subject.startswith(DRAFT):
                    self._became[subject] = uid
                self._add_label(uid, row, event)

    def _add_label(self, uid: str, row: RowChange, event: Event) -> None:
        before, after = row.before or {}, row.after or {}
        for column in ("box", "class_id"):
            if column in before:
                self.first.setdefault((uid, column), before[column])
        then, now = before.get("state"), after.get("state")
        if then == ReviewState.PROPOSED.value:
            self.proposed.add(uid)
        if now in (None, ReviewState.PROPOSED.value):
            return
        decision = REJECTED if now == ReviewState.REJECTED.value else KEPT
        made, is_other = (event.author, event.time_ns), _decision(then) != decision
        if is_other and event.undoes is None:
            self.decided[uid, decision] = made
        elif is_other or (now == ReviewState.EDITED.value and then != now):
            # undo and redo restore somebody's decision; an edited import has had none before
            self.decided.setdefault((uid, decision), made)

    def effort_by_label(self) -> dict[str, tuple[float, float]]:
        """Label uid -> actions and seconds; the effort of an action for several labels is divided equally."""
        spent: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0])
        for action in self.actions.values():
            if action.effort is None:
                continue
            targets = (action.subject,) if action.subject is not None else tuple(action.labels)
            for target in targets:
                entry = spent[self._label(target)]
                entry[0] += action.effort.actions / len(targets)
                entry[1] += action.effort.seconds / len(targets)
        return {uid: (actions, seconds) for uid, (actions, seconds) in spent.items()}

    def _label(self, target: str) -> str:
        if not target.startswith(DRAFT):
            return target
        seen = set()
        while target not in self._became and target in self._moved and target not in seen:
            seen.add(target)
            target = self._moved[target]
        return self._became.get(target, target)

    def _add_image_boxes(self, frame_id: int, row: RowChange) -> None:
        """Records a changed box on the image: the draft's id changes with it."""
        if not row.is_update or row.before is None or row.after is None or "boxes" not in row.after:
            return
        # the id of a draft does not depend on its class
        old, new = (parsed(BOXES_2D.validate_json, state["boxes"]) for state in (row.before, row.after))
        removed, added = [box for box in old if box not in new], [box for box in new if box not in old]
        if len(removed) == len(added) == 1:
            self._moved[draft_id(frame_id, removed[0])] = draft_id(frame_id, added[0])


def _decision(state: str | None) -> str | None:
    if state in (None, ReviewState.PROPOSED.value):
        return None
    return REJECTED if state == ReviewState.REJECTED.value else KEPT


def read_log(connection: Connection) -> ActionLog:
    """Reads all actions."""
    log = ActionLog()
    query = select(events).where(events.c.action.is_not(None), events.c.frame_id.is_not(None)).order_by(events.c.id)
    for row in connection.execute(query):
        log.add(event_of(row))
    return log
