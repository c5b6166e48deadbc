"""The bases of pydantic models."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from annotator.types.boxes import OrientedBox
from annotator.types.label import MOST_TRACK, BoxKind, Said


class Strict(BaseModel):
    """What annotator itself writes, or is told. Unknown fields are refused, so that a misspelt one causes an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class FileRecord(BaseModel):
    """A part of a file; other fields, which other tools may write, are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


TrackId = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]


class SaidRecord(BaseModel):
    """What one source of boxes said of an object, without its box, as annotator writes it into files and projects."""

    source: str = Field(min_length=1, max_length=200)
    label: str = Field(min_length=1)
    score: float | None = Field(None, ge=0, le=1)
    track_id: TrackId | None = None
    box_kind: BoxKind = BoxKind.BOX

    def said(self, box: OrientedBox) -> Said:
        """Returns it with its box."""
        return Said(self.source, self.label, box, self.score, self.track_id, self.box_kind)
