"""What an operator's action is called on the page."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, select

from annotator.project.payloads import LabelState
from annotator.project.schema import AnyRow, frames
from annotator.project.subjects import FRAME, IMAGE, LABEL, VIEW

# What an action is called by its events, the first that fits.
WORDS = (
    ("label_proposed", "propose"),
    ("label_created", "draw"),
    ("label_deleted", "delete"),
    ("label_rejected", "reject"),
    ("label_edited", "edit"),
    ("label_accepted", "accept"),
    ("label_tracked", "track"),
    ("frame_finalised", "finalise"),
    ("frame_reopened", "reopen"),
    ("view_boxes_set", "draw on a view"),
    ("image_boxes_set", "draw on the image"),
)


def named(subject: str, state: str | None) -> str:
    """What a subject is called, such as "the person label"; `state` as of `read_subject`."""
    kind = subject.partition(":")[0]
    if kind == LABEL and state is not None:
        return f"the {LabelState.model_validate_json(state).label} label"
    return {LABEL: "the label", IMAGE: "the boxes on the image", VIEW: "the box on the view", FRAME: "the frame"}[kind]


def words_of(connection: Connection, rows: Sequence[AnyRow]) -> str:
    """Such as "accept person (frame 000012)" or "delete 3 labels (frame 000012)"."""
    where = _place(connection, rows)
    kinds = {row.kind for row in rows}
    kind, verb = next(((kind, word) for kind, word in WORDS if kind in kinds), ("", "change"))
    # what new proposals take the place of is not counted
    counted = [row for row in rows if row.subject.startswith(LABEL) and (verb != "propose" or row.kind == kind)]
    touched = {row.subject: row for row in counted}
    if len(touched) > 1:
        return f"{verb} {len(touched)} labels ({where})"
    for row in touched.values():
        name = LabelState.model_validate_json(row.after or row.before).label
        return f"{verb} {name} ({where})"
    return f"{verb} {where}" if kinds & {"frame_finalised", "frame_reopened"} else f"{verb} ({where})"


def _place(connection: Connection, rows: Sequence[AnyRow]) -> str:
    """Such as "frame 000012" or "frames 000012 to 000019"."""
    first, last = (
        connection.execute(select(frames.c.key).where(frames.c.id == row.frame_id)).scalar_one()
        for row in (rows[0], rows[-1])
    )
    return f"frame {first}" if rows[0].frame_id == rows[-1].frame_id else f"frames {first} to {last}"
