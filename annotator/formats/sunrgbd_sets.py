"""Labels of a whole folder in VoteNet's layout, in upright depth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from annotator.formats.numbered import Meanings
from annotator.formats.sunrgbd_labels import extracted_truth
from annotator.formats.text_folder import text_files
from annotator.types import Truth


@dataclass(frozen=True)
class ExtractedFrame:
    """The labels of one frame.

    Attributes:
        truths: the objects, in upright depth.
        calibration: the file that would say how that lies to the camera; None for labels in an archive.
    """

    truths: tuple[Truth, ...]
    calibration: Path | None


def read_extracted_folder(path: Path) -> dict[str, ExtractedFrame]:
    """The labelled frames, by `RECORDING/KEY` where frames.csv names them, else by the label file's stem.

    Args:
        path: a folder of VoteNet's layout, its folder `label`, or a zip archive of that.

    Raises:
        FormatError: there are no labels, a row is none (with its line), or frames.csv lacks a label file.
    """
    place = path / "label" if (path / "label").is_dir() else path
    meanings = Meanings.of(place)
    found = {}
    for stem, file, text in text_files(place):
        lines = ((line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip())
        truths = [extracted_truth(fields, None, file, line) for line, fields in lines]
        named = tuple(replace(truth, label=meanings.label(truth.label)) for truth in truths)
        calibration = place.parent / "calib" / f"{stem}.txt" if place.is_dir() else None
        found[meanings.frame(stem)] = ExtractedFrame(named, calibration)
    return found
