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

from annotator.project.database.schema import events, revertible
from annotator.project.log.event_types import ImageBoxesState
from annotator.project.log.events import Effort
from annotator.project.log.records import parsed
from annotator.project.log.undo_state import IMAGE, LABEL, Since, present_state
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


# A state is the JSON of a model with one key "state"; quotes in names are escaped, so these texts occur nowhere else.
_STATES = {f'"state":"{state.value}"': state for state in ReviewState}
_PROPOSED, _ACCEPTED, _EDITED, _REJECTED = _STATES

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
        since: what has changed all states.
        actions: by id, in order.
        proposed: label uid -> the JSON of its state as a proposal, for labels that an operator has touched.
        decided: (label uid, KEPT or REJECTED) -> author and time (ns) of the decision.
    """

    since: Since
    actions: dict[str, Action] = field(default_factory=dict)
    proposed: dict[str, str] = field(default_factory=dict)
    decided: dict[tuple[str, str], tuple[str, int]] = field(default_factory=dict)
    _became: dict[str, str] = field(default_factory=dict)
    _moved: dict[str, str] = field(default_factory=dict)

    def add(self, row: Sequence[Any]) -> None:
        """Adds one event of an action: a row of `_LOG`."""
        event_id, frame_id, kind, author, time_ns, action_id, undoes, subject, actions, seconds = row[:10]
        target, before, after = row[10:]
        action = self.actions.get(action_id)
        if action is None:
            effort = None if actions is None else Effort(actions, seconds)
            action = self.actions[action_id] = Action(author, time_ns, effort, subject)
        action.frames[frame_id] = None
        if target == IMAGE:
            self._add_image_boxes(frame_id, before, after)
        elif target.startswith(LABEL):
            uid = target.partition(":")[2]
            action.labels[uid] = None
            if kind == "label_created" and subject is not None and subject.startswith(DRAFT):
                self._became[subject] = uid
            if before is not None and _PROPOSED in before and uid not in self.proposed:
                self.proposed[uid] = present_state(self.since, frame_id, target, before, event_id) or before
            self._add_decision(uid, before, after, undoes is not None, (author, time_ns))

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

    def _add_image_boxes(self, frame_id: int, before: str | None, after: str | None) -> None:
        """Records a changed box on the image: the draft's id changes with it."""
        if before is None or after is None:
            return
        old, new = (parsed(ImageBoxesState.model_validate_json, state).boxes for state in (before, after))
        removed, added = [box for box in old if box not in new], [box for box in new if box not in old]
        if len(removed) == len(added) == 1:
            self._moved[draft_id(frame_id, removed[0])] = draft_id(frame_id, added[0])

    def _add_decision(
        self, uid: str, before: str | None, after: str | None, restores: bool, made: tuple[str, int]
    ) -> None:
        then, now = _decision(before), _decision(after)
        if now is None:
            return
        if then != now and not restores:
            self.decided[uid, now] = made
        elif then != now or (_is_edited(after) and not _is_edited(before)):
            # undo and redo restore somebody's decision; an edited import has had none before
            self.decided.setdefault((uid, now), made)


def _decision(state: str | None) -> str | None:
    if state is None or _PROPOSED in state:
        return None
    return REJECTED if _REJECTED in state else KEPT


def _is_edited(state: str | None) -> bool:
    return state is not None and _EDITED in state


_LOG = (
    select(
        *(events.c[name] for name in ("id", "frame_id", "kind", "author", "time_ns", "action", "undoes", "subject")),
        events.c.actions,
        events.c.seconds,
        revertible.c.subject,
        revertible.c.before,
        revertible.c.after,
    )
    .join(revertible, revertible.c.event_id == events.c.id)
    .order_by(events.c.id)
)


def read_log(connection: Connection) -> ActionLog:
    """Reads all actions."""
    log = ActionLog(Since(connection))
    for row in connection.execute(_LOG):
        log.add(row)
    return log
