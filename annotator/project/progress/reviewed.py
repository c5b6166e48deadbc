"""The operators' actions, and the labels that they have reviewed: their origins, effort, and proposals.

A project has ten thousands of reviewed labels, so only those that differ from their proposals are compared with them,
as arrays.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from sqlalchemy import Connection, func, select

from annotator.geometry.iou import intersection_volume_pairs
from annotator.geometry.oriented_box import SAME_BOX
from annotator.project.audit.events import Effort, Event, RowChange, event_of, without_rows
from annotator.project.changes import Origin
from annotator.project.database.schema import AnyRow, events, labels
from annotator.project.records import BOXES_2D, parsed
from annotator.project.rows import T_camera_stored, Terms, still_of
from annotator.project.sources import KIND as IMPORTED
from annotator.types import Box2D, ReviewState, Source

DRAFT = "draft-"

UNTOUCHED, CORRECTED, FROM_NOTHING = "proposal accepted untouched", "proposal edited", "from nothing"
PLACED, COPIED, STILL, IMPORT_EDITED = "placed in 3D", "copied", "of a still object", "import edited"
ORIGINS = (UNTOUCHED, CORRECTED, FROM_NOTHING, PLACED, COPIED, STILL, IMPORT_EDITED)
_MANUAL = {None: FROM_NOTHING, Origin.DRAWN: FROM_NOTHING, Origin.PLACED: PLACED, Origin.COPIED: COPIED}
_MANUAL |= {Origin.STILL: STILL}


def draft_id(frame_id: int, image_box: Box2D) -> str:
    """Id of a draft: an unfinished object without a label. Its effort is counted under this id."""
    edges = ",".join(f"{edge:.3f}" for edge in image_box.xyxy)
    return DRAFT + hashlib.sha256(f"{frame_id}:{edges}".encode()).hexdigest()[:20]


@dataclass(slots=True)
class Action:
    """One action of an operator.

    Attributes:
        time_ns: of its first event.
        effort: None if it was not counted.
        subject: uid of the label or id of the draft that the effort was for, if given.
        labels, frames: uids and ids of what it changed, each once.
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
        decided: (label uid, whether it was rejected) -> author and time (ns) of the decision.
    """

    actions: dict[str, Action] = field(default_factory=dict)
    proposed: set[str] = field(default_factory=set)
    first: dict[tuple[str, str], Any] = field(default_factory=dict)
    decided: dict[tuple[str, bool], tuple[str, int]] = field(default_factory=dict)
    _became: dict[str, str] = field(default_factory=dict)
    _moved: dict[str, str] = field(default_factory=dict)

    def add(self, event: Event) -> None:
        """Adds one event of an action."""
        assert event.action is not None and event.frame_id is not None  # as every action
        subject = event.effort_target
        action = self.actions.setdefault(event.action, Action(event.author, event.time_ns, event.effort, subject))
        action.frames[event.frame_id] = None
        for row in event.rows:
            if row.table == "image_labels":
                self._add_image_boxes(event.frame_id, row)
            elif row.table in ("labels", "stills") and not row.is_behind:
                uid = str(row.key)
                action.labels[uid] = None
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
        if (is_rejected := _is_rejected(now)) is None:
            return
        made, is_other = (event.author, event.time_ns), _is_rejected(then) is not is_rejected
        if is_other and event.undoes is None:
            self.decided[uid, is_rejected] = made
        elif is_other or (now == ReviewState.EDITED.value and then != now):
            # undo and redo restore somebody's decision; an edited import has had none before
            self.decided.setdefault((uid, is_rejected), made)

    def effort_by_label(self) -> dict[str, tuple[float, float]]:
        """Label uid -> actions and seconds; the effort of an action for several labels is divided equally."""
        spent: dict[str, tuple[float, float]] = defaultdict(lambda: (0.0, 0.0))
        for action in self.actions.values():
            if (effort := action.effort) is None:
                continue
            targets = (action.subject,) if action.subject is not None else tuple(action.labels)
            for uid in map(self._label, targets):
                actions, seconds = spent[uid]
                spent[uid] = actions + effort.actions / len(targets), seconds + effort.seconds / len(targets)
        return spent

    def _label(self, target: str) -> str:
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


def _is_rejected(state: str | None) -> bool | None:
    """None for a label that is open, or not there."""
    return None if state in (None, ReviewState.PROPOSED.value) else state == ReviewState.REJECTED.value


def read_log(connection: Connection) -> ActionLog:
    """Reads all actions."""
    log = ActionLog()
    # nobody has decided about imported proposals
    query = select(*without_rows(events.c.kind == IMPORTED)).where(events.c.action.is_not(None))
    # a pass is no work of an operator
    query = query.where(events.c.frame_id.is_not(None), events.c.source != Source.AUTO.value)
    for row in connection.execute(query.order_by(events.c.id)):
        log.add(event_of(row))
    return log


class ReviewedBox(NamedTuple):
    """A label that is not open any more.

    Attributes:
        label: its class.
        range_m: distance of its centre from the camera.
        was_proposed: whether an automatic pass, or following, proposed it.
        origin: one of `ORIGINS`; None if rejected, or imported and not edited.
        iou: exact 3D IoU of its box as proposed and as it is now; None if rejected or not proposed.
        effort: actions and seconds; None if none were counted.
        decided: who accepted, made or rejected it, and when (ns); None if no operator has.
    """

    frame_id: int
    label: str
    range_m: float
    is_rejected: bool
    was_proposed: bool
    origin: str | None
    iou: float | None
    effort: tuple[float, float] | None
    decided: tuple[str, int] | None


def read_reviewed(connection: Connection, log: ActionLog) -> list[ReviewedBox]:
    """All reviewed labels, in the order of their creation."""
    columns = ("uid", "frame_id", "label", "class_id", "box", "source", "state", "origin", "proposed_box", "id")
    centers = [func.json_extract(labels.c.box, f"$.center_m[{axis}]") for axis in range(3)]
    query = select(*(labels.c[name] for name in columns), *centers)
    query = query.where(labels.c.state != ReviewState.PROPOSED.value).order_by(labels.c.id)
    rows, terms, spent = connection.execute(query).all(), Terms(connection), log.effort_by_label()
    compared, boxes = _compared(rows, log, terms), []
    for row in rows:
        T, is_rejected = T_camera_stored(row.box, terms.place(row.frame_id)), row.state == ReviewState.REJECTED.value
        iou, is_same = compared.get(row.uid, (None, None))
        uid = still_of(row.uid) or row.uid
        boxes.append(
            ReviewedBox(
                frame_id=row.frame_id,
                label=row.label,
                range_m=math.hypot(*(row[-3:] if T is None else T[:3, :3] @ row[-3:] + T[:3, 3])),
                is_rejected=is_rejected,
                was_proposed=is_same is not None or row.proposed_box is not None,
                origin=None if is_rejected else _origin(row, is_same),
                iou=None if is_rejected else iou,
                # that of an object which stands still, in the first frame
                effort=spent.get(uid) if uid == row.uid else spent.pop(uid, None),
                decided=log.decided.get((uid, is_rejected)),
            )
        )
    return boxes


def _origin(row: AnyRow, is_same: bool | None) -> str | None:
    """The origin of a label that is, or is not, as it was proposed (None: nobody has reviewed it as a proposal)."""
    if is_same is None and row.proposed_box is not None:  # reviewed when annotator did not record actions
        is_same = row.state == ReviewState.ACCEPTED.value
    if is_same is not None:
        return UNTOUCHED if is_same else CORRECTED
    if row.source == Source.IMPORTED.value and row.origin is None:
        return IMPORT_EDITED if row.state == ReviewState.EDITED.value else None
    return _MANUAL[row.origin]


def _compared(rows: Sequence[AnyRow], log: ActionLog, terms: Terms) -> dict[str, tuple[float, bool]]:
    """Label uid -> exact 3D IoU with its proposal, and whether class and box are the same, for labels that have one.

    Compares class and box, since an edited label that was accepted afterwards has the state "accepted".
    """
    results: dict[str, tuple[float, bool]] = {}
    changed, then, same_class = list[AnyRow](), list[str](), list[bool]()
    for row in rows:
        uid = still_of(row.uid) or row.uid
        # a copy was open, too, but nobody else proposed it
        if uid not in log.proposed or row.origin not in (None, Origin.STILL):
            continue
        box = log.first.get((uid, "box"), row.box)
        is_same = terms.names[log.first.get((uid, "class_id"), row.class_id)] == row.label
        if box == row.box and is_same:
            results[row.uid] = (1.0, True)
        else:
            changed.append(row)
            then.append(box)
            same_class.append(is_same)
    if not changed:
        return results
    before, now = (parsed(_boxes, f"[{','.join(texts)}]") for texts in (then, [row.box for row in changed]))
    apart = [np.abs(a - b).reshape(len(changed), -1).max(axis=1) for a, b in zip(now, before, strict=True)]
    is_same_box = np.max(apart, axis=0) <= SAME_BOX
    shared = intersection_volume_pairs(*now, *before)
    ious = np.minimum(shared / (now[2].prod(axis=1) + before[2].prod(axis=1) - shared), 1.0)
    same = (is_same_box & same_class).tolist()
    return results | dict(zip((row.uid for row in changed), zip(ious.tolist(), same, strict=True), strict=True))


def _boxes(content: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (n, 3), rotations (n, 3, 3) and sizes (n, 3), metres, of a JSON list of `BoxRecord`s."""
    records = json.loads(content)
    centers, rotations, sizes = (
        np.array([record[key] for record in records], np.float64) for key in ("center_m", "rotation", "size_m")
    )
    return centers.reshape(-1, 3), rotations.reshape(-1, 3, 3), sizes.reshape(-1, 3)
