"""The labels that people have reviewed: where each came from, what it cost, and how good its proposal was.

A project has ten thousands of them, so only those that differ from their proposals are compared with them, as arrays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64
from pydantic_core import to_json
from sqlalchemy import Connection, func, select

from annotator.geometry.iou import intersection_volume_pairs
from annotator.geometry.oriented_box import SAME_BOX
from annotator.project.database.schema import AnyRow, labels
from annotator.project.log.event_types import Origin
from annotator.project.log.records import parsed
from annotator.project.progress.action_log import (
    COPIED,
    CORRECTED,
    FROM_NOTHING,
    IMPORT_EDITED,
    KEPT,
    PLACED,
    REJECTED,
    UNTOUCHED,
    ActionLog,
)
from annotator.types import ReviewState, Source

_MANUAL = {Origin.DRAWN: FROM_NOTHING, Origin.PLACED: PLACED, Origin.COPIED: COPIED, None: FROM_NOTHING}


class ReviewedBox(NamedTuple):
    """A label that is not open any more.

    Attributes:
        label: its class.
        range_m: distance of its centre from the camera.
        is_rejected: whether its proposal was rejected.
        was_proposed: whether an automatic pass, or following, proposed it.
        origin: one of `efforts.ORIGINS`; None if rejected, or imported and not edited.
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
    columns = ("uid", "frame_id", "label", "box", "source", "state", "origin", "proposal_event_id")
    centers = [func.json_extract(labels.c.box, f"$.center_m[{axis}]") for axis in range(3)]
    query = select(*(labels.c[name] for name in columns), *centers)
    query = query.where(labels.c.state != ReviewState.PROPOSED.value).order_by(labels.c.id)
    rows = connection.execute(query).all()
    ranges = [math.hypot(*row[-3:]) for row in rows]
    comparisons = _compared(rows, log.proposed)
    spent = log.effort_by_label()
    return [
        _reviewed(row, range_m, comparisons.get(row.uid), spent.get(row.uid), log)
        for row, range_m in zip(rows, ranges, strict=True)
    ]


def _reviewed(
    row: AnyRow,
    range_m: float,
    compared: _Compared | None,
    effort: tuple[float, float] | None,
    log: ActionLog,
) -> ReviewedBox:
    is_rejected = row.state == ReviewState.REJECTED.value
    return ReviewedBox(
        frame_id=row.frame_id,
        label=row.label,
        range_m=range_m,
        is_rejected=is_rejected,
        was_proposed=compared is not None or row.proposal_event_id is not None,
        origin=None if is_rejected else _origin(row, compared),
        iou=None if is_rejected or compared is None else compared.iou,
        effort=effort,
        decided=log.decided.get((row.uid, REJECTED if is_rejected else KEPT)),
    )


def _origin(row: AnyRow, compared: _Compared | None) -> str | None:
    if compared is not None:
        return UNTOUCHED if compared.is_same else CORRECTED
    if row.proposal_event_id is not None:  # reviewed with a version of annotator that did not record actions
        return UNTOUCHED if row.state == ReviewState.ACCEPTED.value else CORRECTED
    if row.source == Source.IMPORTED.value:
        return IMPORT_EDITED if row.state == ReviewState.EDITED.value else None
    return _MANUAL[None if row.origin is None else Origin(row.origin)]


class _Boxes(NamedTuple):
    """Centres and sizes in metres, and rotations."""

    centers: Float64[np.ndarray, "n 3"]
    rotations: Float64[np.ndarray, "n 3 3"]
    sizes: Float64[np.ndarray, "n 3"]


class _Compared(NamedTuple):
    """A label and its proposal: the exact 3D IoU of their boxes, and whether class and box are the same."""

    iou: float
    is_same: bool


def _listed(texts: Sequence[str]) -> str:
    """One JSON list of JSON texts."""
    return f"[{','.join(texts)}]"


def _boxes(records: str) -> _Boxes:
    """The boxes of a JSON list of `BoxRecord`s."""
    return _stacked(json.loads(records))


def _stacked(records: Sequence[Mapping[str, Any]]) -> _Boxes:
    def stack(key: str, *shape: int) -> np.ndarray:
        return np.array([record[key] for record in records], np.float64).reshape(-1, *shape)

    return _Boxes(stack("center_m", 3), stack("rotation", 3, 3), stack("size_m", 3))


def _classes_and_boxes(states: str) -> tuple[list[str], _Boxes]:
    """Of a JSON list of `LabelState`s."""
    records = json.loads(states)
    return [record["label"] for record in records], _stacked([record["box"] for record in records])


def _compared(rows: Sequence[AnyRow], proposed: Mapping[str, str]) -> dict[str, _Compared]:
    """Label uid -> how it differs from its proposal, for the labels that have one.

    Compares class and box, since an edited label that was accepted afterwards has the state "accepted".
    """
    results: dict[str, _Compared] = {}
    changed = []
    for n, row in enumerate(rows):
        state = proposed.get(row.uid)
        # a copy was open, too, but nobody else proposed it
        if state is None or row.origin is not None:
            continue
        # as `LabelState` begins; whatever is written otherwise is compared by its numbers
        if state.startswith(f'{{"label":{to_json(row.label).decode()},"box":{row.box},'):
            results[row.uid] = _Compared(1.0, True)
        else:
            changed.append(n)
    if not changed:
        return results
    classes, then = parsed(_classes_and_boxes, _listed([proposed[rows[n].uid] for n in changed]))
    now = parsed(_boxes, _listed([rows[n].box for n in changed]))
    apart = [np.abs(a - b).reshape(len(changed), -1).max(axis=1) for a, b in zip(now, then, strict=True)]
    is_same = np.max(apart, axis=0) <= SAME_BOX
    shared = intersection_volume_pairs(*now, *then)
    ious = np.minimum(shared / (now.sizes.prod(axis=1) + then.sizes.prod(axis=1) - shared), 1.0)
    for n, name, same, iou in zip(changed, classes, is_same.tolist(), ious.tolist(), strict=True):
        results[rows[n].uid] = _Compared(iou, same and name == rows[n].label)
    return results
