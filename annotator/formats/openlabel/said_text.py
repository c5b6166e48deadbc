"""What sources of boxes said of an object, as the text `said_by` of its cuboid: a JSON list.

    [{"source": "detector", "type": "car", "val": [...], "score": 0.9, "track_id": 3, "box_kind": "silhouette"}, ...]

`type` and `val` are as in OpenLABEL's objects and cuboids, in the cuboid's coordinate system; the last three are
left out if they are unknown or as usual.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from annotator.formats.json_file import Bounded, BoundedTrack
from annotator.formats.openlabel.shapes import box_from, cuboid_values
from annotator.types import BoxKind
from annotator.types.label import Said
from annotator.types.messages import first_problem

SAID_BY = "said_by"


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")

    source: Annotated[str, Field(min_length=1, max_length=200)]
    type: Annotated[str, Field(min_length=1)]
    val: Annotated[tuple[Bounded, ...], Field(min_length=10, max_length=10)]
    score: Annotated[float, Field(ge=0, le=1)] | None = None
    track_id: BoundedTrack | None = None
    box_kind: BoxKind = BoxKind.BOX


_ENTRIES: TypeAdapter[tuple[_Entry, ...]] = TypeAdapter(tuple[_Entry, ...])


def said_text(said: Sequence[Said]) -> str:
    """Returns the text."""
    entries = tuple(
        _Entry(
            source=each.source,
            type=each.label,
            val=cuboid_values(each.box),
            score=each.score,
            track_id=each.track_id,
            box_kind=each.box_kind,
        )
        for each in said
    )
    return _ENTRIES.dump_json(entries, exclude_defaults=True).decode()


def said_from(text: str) -> tuple[Said, ...]:
    """Returns what a text says.

    Raises:
        ValueError: it is not such a list; the message says what is wrong.
    """
    try:
        entries = _ENTRIES.validate_json(text)
    except ValidationError as error:
        raise ValueError(f"{first_problem(error, SAID_BY)}; correct it or leave it out") from error
    return tuple(
        Said(each.source, each.type, box_from(each.val), each.score, each.track_id, each.box_kind) for each in entries
    )
