"""The bases of pydantic models."""

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """What annotator itself writes, or is told. Unknown fields are refused, so that a misspelt one causes an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class FileRecord(BaseModel):
    """A part of a file; other fields, which other tools may write, are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")
