"""The adjustment of a recording: its up direction and the correction of its calibration."""

from __future__ import annotations

import json
from dataclasses import dataclass

from pydantic import TypeAdapter
from sqlalchemy import Connection, delete, insert, select

from annotator.project.records import parsed
from annotator.project.schema import AnyRow, adjustments, recordings
from annotator.types import NO_CORRECTION, Correction

Up = tuple[float, float, float]


@dataclass(frozen=True)
class Adjustment:
    """What the project sets for a recording.

    Attributes:
        up: unit vector against gravity in the (corrected) camera frame; None = as the files give it.
        correction: of the calibration.
    """

    up: Up | None
    correction: Correction = NO_CORRECTION


_ADJUSTMENT: TypeAdapter[Adjustment] = TypeAdapter(Adjustment)
_CORRECTION: TypeAdapter[Correction] = TypeAdapter(Correction)


def adjustment_json(adjustment: Adjustment) -> str:
    """An adjustment as JSON; equal texts are equal adjustments."""
    return _ADJUSTMENT.dump_json(adjustment).decode()


def adjustment_of(content: str) -> Adjustment:
    """The adjustment of a JSON text."""
    return parsed(_ADJUSTMENT.validate_json, content)


def read_adjustment(connection: Connection, recording_id: int) -> Adjustment:
    """The present adjustment of a recording; without any event, the up direction that it was added with."""
    row = connection.execute(select(adjustments).where(adjustments.c.recording_id == recording_id)).first()
    if row is not None:
        return Adjustment(_up(row.up), parsed(_CORRECTION.validate_json, row.correction))
    added = select(recordings.c.up).where(recordings.c.id == recording_id)
    return Adjustment(_up(connection.execute(added).scalar_one()))


def put_adjustment(connection: Connection, recording_id: int, adjustment: Adjustment, event_id: int) -> None:
    """Replaces the adjustment of a recording."""
    connection.execute(delete(adjustments).where(adjustments.c.recording_id == recording_id))
    row = {
        "recording_id": recording_id,
        "up": None if adjustment.up is None else json.dumps(adjustment.up),
        "correction": _CORRECTION.dump_json(adjustment.correction).decode(),
        "event_id": event_id,
    }
    connection.execute(insert(adjustments), row)


def adjustment_in(row: AnyRow) -> tuple[Adjustment, int]:
    """The adjustment in a row of recordings joined with adjustments, and the id of its event (0 = none)."""
    if row.adjusted is None:
        return Adjustment(_up(row.up)), 0
    return Adjustment(_up(row.adjusted_up), parsed(_CORRECTION.validate_json, row.correction)), row.adjusted


def _up(content: str | None) -> Up | None:
    return None if content is None else tuple(parsed(json.loads, content))
