"""The labels that people have reviewed: where each came from, what it cost, and how good its proposal was.

A project has ten thousands of them, so only those that differ from their proposals are compared with them, as arrays.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from sqlalchemy import Connection, func, select

from annotator.geometry.iou import intersection_volume_pairs
from annotator.geometry.oriented_box import SAME_BOX
from annotator.project.changes import Origin
from annotator.project.database.schema import AnyRow, labels
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
from annotator.project.records import parsed
from annotator.project.rows import Terms
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
    columns = ("uid", "frame_id", "label", "class_id", "box", "source", "state", "origin", "proposed_box")
    centers = [func.json_extract(labels.c.box, f"$.center_m[{axis}]") for axis in range(3)]
    query = select(*(labels.c[name] for name in columns), *centers)
    query = query.where(labels.c.state != ReviewState.PROPOSED.value).order_by(labels.c.id)
    rows, terms = connection.execute(query).all(), Terms(connection)
    ranges = [_range_m(row, terms) for row in rows]
    comparisons = _compared(rows, log, terms)
    spent = log.effort_by_label()
    return [
        _reviewed(row, range_m, comparisons.get(row.uid), spent.get(row.uid), log)
        for row, range_m in zip(rows, ranges, strict=True)
    ]


def _range_m(row: AnyRow, terms: Terms) -> float:
    T = terms.T_camera_cloud(row.frame_id)
    return math.hypot(*(row[-3:] if T is None else T.apply(row[-3:])))


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
        was_proposed=compared is not None or row.proposed_box is not None,
        origin=None if is_rejected else _origin(row, compared),
        iou=None if is_rejected or compared is None else compared.iou,
        effort=effort,
        decided=log.decided.get((row.uid, REJECTED if is_rejected else KEPT)),
    )


def _origin(row: AnyRow, compared: _Compared | None) -> str | None:
    if compared is not None:
        return UNTOUCHED if compared.is_same else CORRECTED
    if row.proposed_box is not None:  # reviewed with a version of annotator that did not record actions
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


def _boxes(content: str) -> _Boxes:
    """The boxes of a JSON list of `BoxRecord`s."""
    records = json.loads(content)

    def stack(key: str, *shape: int) -> np.ndarray:
        return np.array([record[key] for record in records], np.float64).reshape(-1, *shape)

    return _Boxes(stack("center_m", 3), stack("rotation", 3, 3), stack("size_m", 3))


def _compared(rows: Sequence[AnyRow], log: ActionLog, terms: Terms) -> dict[str, _Compared]:
    """Label uid -> how it differs from its proposal, for the labels that have one.

    Compares class and box, since an edited label that was accepted afterwards has the state "accepted".
    """
    results: dict[str, _Compared] = {}
    changed, then = list[AnyRow](), list[str]()
    for row in rows:
        # a copy was open, too, but nobody else proposed it
        if row.uid not in log.proposed or row.origin is not None:
            continue
        box = log.first.get((row.uid, "box"), row.box)
        if box == row.box and _first_class(row, log, terms) == row.label:
            results[row.uid] = _Compared(1.0, True)
        else:
            changed.append(row)
            then.append(box)
    if not changed:
        return results
    before, now = (parsed(_boxes, f"[{','.join(texts)}]") for texts in (then, [row.box for row in changed]))
    apart = [np.abs(a - b).reshape(len(changed), -1).max(axis=1) for a, b in zip(now, before, strict=True)]
    is_same = np.max(apart, axis=0) <= SAME_BOX
    shared = intersection_volume_pairs(*now, *before)
    ious = np.minimum(shared / (now.sizes.prod(axis=1) + before.sizes.prod(axis=1) - shared), 1.0)
    for row, same, iou in zip(changed, is_same.tolist(), ious.tolist(), strict=True):
        results[row.uid] = _Compared(iou, same and _first_class(row, log, terms) == row.label)
    return results


def _first_class(row: AnyRow, log: ActionLog, terms: Terms) -> str:
    return terms.names[log.first.get((row.uid, "class_id"), row.class_id)]
