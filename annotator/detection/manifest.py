"""What a training set is made of, as it is written beside its pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.types import BoxKind
from annotator.types.errors import FormatError

MANIFEST_NAME = "manifest.json"
Split = Literal["train", "val"]


class ManifestEntry(BaseModel):
    """One picture of a training set.

    Attributes:
        image: its file, relative to the set's folder.
        split: trained on, or held back to measure.
        group: the frame it comes from; all pictures of a group share a split.
        origin: how its boxes came about, such as "drawn" or "projected".
        label_uids: the project's labels that its boxes come from, where there are any.
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
    """A whole training set.

    Attributes:
        version: of this file's format.
        sha256: of all pictures, labels, classes and the split; the same labels give the same hash.
        classes: names, in the order of the class numbers in the label files.
        kind: what the boxes measure; None for boxes on camera images, where it does not matter.
        seed, val_share: what decided the split.
        measured_on: "train" where there were too few groups to hold any back, so that its metrics flatter.
        images: number of pictures by split.
        boxes_by_class: number of boxes by split and class.
        images_by_origin: number of pictures by split and origin.
        dropped_boxes: boxes left out because nothing of them lies on their picture.
        entries: every picture.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[1] = 1
    sha256: str
    classes: tuple[str, ...]
    kind: BoxKind | None
    seed: int
    val_share: float
    measured_on: Split
    images: dict[Split, int]
    boxes_by_class: dict[Split, dict[str, int]]
    images_by_origin: dict[Split, dict[str, int]]
    dropped_boxes: int
    entries: tuple[ManifestEntry, ...]


def read_manifest(folder: Path) -> DatasetManifest:
    """The manifest of a training set folder.

    Raises:
        FormatError: the folder has no manifest, or one that cannot be read.
    """
    path = folder / MANIFEST_NAME
    try:
        return DatasetManifest.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise FormatError(path, "no such file; this folder is not a training set written by annotator") from error
    except (OSError, ValidationError) as error:
        raise FormatError(path, f"not a training set manifest ({error}); write the training set again") from error
