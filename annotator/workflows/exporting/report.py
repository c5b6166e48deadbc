"""What an export wrote, and what its format could not hold."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.formats.losses import Loss


class ExportReport(BaseModel):
    """The result of an export.

    Attributes:
        format: of the dataset.
        out: where it is.
        frames: how many (pictures, in formats of 2D boxes).
        objects: boxes in all.
        objects_by_class: with every class of the dataset, also those without a box.
        splits: frames of each part; empty where it is not divided.
        losses: what the format could not hold.
        unreadable: frames that were left out, as `RECORDING/KEY: reason`.
        notes: what else to know of it, a line each.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: str
    out: Path
    frames: int
    objects: int
    objects_by_class: dict[str, int]
    splits: dict[str, int] = {}
    losses: tuple[Loss, ...] = ()
    unreadable: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
