"""The manifest of a training set, written beside its images."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.files import TABLE_BYTES, read_file
from annotator.types import BoxKind
from annotator.types.errors import FormatError

MANIFEST_NAME = "manifest.json"
Split = Literal["train", "val"]


class ManifestEntry(BaseModel):
    """One image of a training set.

    Attributes:
        image: its file, relative to the set's folder.
        split: training or validation.
        group: the source frame; all images of a group share a split.
        origin: where its boxes come from, such as "drawn" or "projected".
        label_uids: uids of the project's labels that its boxes come from, if any.
        boxes: class names of its boxes, in the order of the label file.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    image: str
    split: Split
    group: str
    origin: str
    label_uids: tuple[str, ...] = ()
    boxes: tuple[str, ...]


class DatasetManifest(BaseModel):
    """A training set.

    Attributes:
        version: of this file's format.
        sha256: hash of all images, labels, classes and the split.
        classes: names, in the order of the class numbers in the label files.
        kind: what the boxes measure; None for boxes on camera images.
        measured_on: the split on which the metrics are measured; "train" if there were too few groups, which makes
            them too optimistic.
        images: number of images by split.
        boxes_by_class: number of boxes by split and class.
        images_by_origin: number of images by split and origin.
        dropped_boxes: number of boxes that were dropped because they lie outside their image.
        entries: all images.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    sha256: str
    classes: tuple[str, ...]
    kind: BoxKind | None
    measured_on: Split
    images: dict[Split, int]
    boxes_by_class: dict[Split, dict[str, int]]
    images_by_origin: dict[Split, dict[str, int]]
    dropped_boxes: int
    entries: tuple[ManifestEntry, ...]


def read_manifest(folder: Path) -> DatasetManifest:
    """Reads the manifest of a training set folder.

    Raises:
        FormatError: there is no manifest, or it cannot be read.
    """
    path = folder / MANIFEST_NAME
    try:
        return DatasetManifest.model_validate_json(read_file(path, TABLE_BYTES))
    except FileNotFoundError as error:
        raise FormatError(path, "no such file; this folder is not a training set written by annotator") from error
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a training set manifest ({error}); write the training set again") from error
