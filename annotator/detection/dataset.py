"""Labelled images as a YOLO training set: tiles, the held-out frames, the folder and its manifest.

The folder holds `images/{train,val}`, `labels/{train,val}` (one text file per image, `class cx cy w h` as shares of the
image size; an empty file marks a background image), `data.yaml` and `manifest.json`.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8
from pydantic import BaseModel, ValidationError

from annotator.files import TABLE_BYTES, new_folder, read_file
from annotator.geometry.outline import clip_to_image, shares_of
from annotator.image_bytes import read_image
from annotator.types import Box2D, BoxKind
from annotator.types.bases import Strict
from annotator.types.detector import Picture
from annotator.types.errors import ConfigError, DetectionError, FormatError
from annotator.types.messages import first_problem

MANIFEST_NAME = "manifest.json"
Split = Literal["train", "val"]
Record = TypeVar("Record", bound=BaseModel)


class ManifestEntry(Strict):
    """One image of a training set.

    Attributes:
        group: the source frame; all images of a group share a split.
        origin: where its boxes come from, such as "drawn" or "projected".
        label_uids: uids of the project's labels that its boxes come from, if any.
        boxes: class names of its boxes, in the order of the label file.
    """

    image: str
    split: Split
    group: str
    origin: str
    label_uids: tuple[str, ...] = ()
    boxes: tuple[str, ...]


class DatasetManifest(Strict):
    """A training set.

    Attributes:
        kind: what the boxes measure; None for boxes on camera images.
        measured_on: the split on which the metrics are measured; "train" if there were too few groups, which makes
            them too optimistic.
    """

    version: Literal[1] = 1
    sha256: str
    classes: tuple[str, ...]
    kind: BoxKind | None
    measured_on: Split
    images: dict[Split, int]
    entries: tuple[ManifestEntry, ...]


def read_record(path: Path, model: type[Record], missing: str, remedy: str) -> Record:
    """Reads a JSON file beside a training; `missing` and `remedy` are what the error says."""
    try:
        return model.model_validate_json(read_file(path, TABLE_BYTES))
    except FileNotFoundError as error:
        raise FormatError(path, f"no such file; {missing}") from error
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror or error}); {remedy}") from error
    except ValidationError as error:
        raise FormatError(path, f"has other content ({first_problem(error)}); {remedy}") from error


def read_manifest(folder: Path) -> DatasetManifest:
    missing = "this folder is not a training set written by annotator"
    return read_record(folder / MANIFEST_NAME, DatasetManifest, missing, "write the training set again")


SHARE = 0.2


def is_held_out(group: str, share: float = SHARE) -> bool:
    """Whether a frame is held out, by a hash of its samples' group: always the same, whatever else is labelled."""
    number = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8], "big")
    return number < share * 2**64


# Boxes whose part inside the image has a shorter side are dropped, pixels.
MIN_SIDE_PX = 1.0
# Origin of the boxes on views of generated frames.
GENERATED = "generated"
SPLITS: tuple[Split, Split] = ("train", "val")

Rgb = UInt8[np.ndarray, "h w 3"]


def read_picture(path: Path) -> Picture:
    try:
        bgr = read_image(path, cv2.IMREAD_COLOR)
    except (OSError, ValueError) as error:
        raise DetectionError(
            f"{path}: training image cannot be read ({error}); restore the file or remove its labels"
        ) from error
    return Picture(np.ascontiguousarray(bgr[:, :, ::-1]))


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """One labelled image.

    Attributes:
        rgb: (H, W, 3) uint8 in RGB order.
        group: key of the source frame; images of one group are never split between training and validation.
        origin: where the boxes come from, such as "drawn", "imported" or "projected".
        label_uids: uids of the source labels, for the first boxes; may be shorter than `boxes`.
        look_px: longer side at which the detector will see this image, pixels; 0: the training size (see `tiles`).
    """

    rgb: Rgb
    boxes: tuple[Box2D, ...]
    group: str
    origin: str
    label_uids: tuple[str, ...] = ()
    look_px: int = 0


def write_dataset(
    folder: Path,
    samples: Iterable[TrainingSample],
    classes: Sequence[str],
    is_held_out: Callable[[str], bool] = is_held_out,
    kind: BoxKind | None = None,
) -> DatasetManifest:
    """Writes a training set, with one image in memory at a time, and returns its manifest.

    The set is written beside `folder` and then renamed, so `folder` is never incomplete. An existing training set is
    replaced.

    Args:
        is_held_out: whether a group's images validate; the others train. If no group with boxes validates, the
            training images are used for validation, and the manifest records this.
        kind: what the boxes measure; recorded in the manifest.
    """
    _check(folder, classes)
    with new_folder(folder, lambda _: True) as temporary:  # `_check` refuses any other folder
        digest = hashlib.sha256(json.dumps([list(classes), kind], ensure_ascii=False).encode())
        entries = []
        for index, sample in enumerate(samples):
            split: Split = "val" if is_held_out(sample.group) else "train"
            entry, content = _write_sample(temporary, f"{index:06d}", sample, classes, split)
            entries.append(entry)
            digest.update(f"{split} {content}\n".encode())
        _require_training(entries)
        manifest = DatasetManifest(
            sha256=digest.hexdigest(),
            classes=tuple(classes),
            kind=kind,
            measured_on="val" if any(entry.boxes for entry in entries if entry.split == "val") else "train",
            images={split: sum(entry.split == split for entry in entries) for split in SPLITS},
            entries=tuple(entries),
        )
        (temporary / MANIFEST_NAME).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")
        (temporary / "data.yaml").write_text(_data_yaml(classes, manifest.measured_on), encoding="utf-8")
    return manifest


def yolo_line(box: Box2D, width_px: int, height_px: int, class_number: int) -> str | None:
    """`class cx cy w h` as shares of the image size, clipped to the image; None if the box is outside or too small."""
    cut = clip_to_image(box, width_px, height_px, MIN_SIDE_PX)
    if cut is None:
        return None
    return " ".join([str(class_number), *(f"{share:.7f}" for share in shares_of(cut, width_px, height_px))])


def _check(folder: Path, classes: Sequence[str]) -> None:
    if not classes or len(set(classes)) != len(classes) or not all(name.strip() for name in classes):
        raise ConfigError(f"the class names of a training set must be unique and not empty, but are {list(classes)}")
    if folder.exists() and not (folder / MANIFEST_NAME).is_file() and (folder.is_file() or any(folder.iterdir())):
        raise DetectionError(f"{folder}: exists and is not a training set; choose another folder or remove it")


def _write_sample(
    folder: Path, stem: str, sample: TrainingSample, classes: Sequence[str], split: Split
) -> tuple[ManifestEntry, str]:
    """Writes an image and its labels; returns its entry, and a hash of both."""
    rgb = sample.rgb
    height_px, width_px = rgb.shape[:2]
    numbers = {name: number for number, name in enumerate(classes)}
    lines, names = [], []
    for box in sample.boxes:
        if box.label not in numbers:
            raise ConfigError(
                f"a box on frame {sample.group} is of class {box.label!r}, which is not in {list(classes)}"
            )
        line = yolo_line(box, width_px, height_px, numbers[box.label])
        if line is not None:
            lines.append(line + "\n")
            names.append(box.label)
    for kind in ("images", "labels"):
        (folder / kind / split).mkdir(parents=True, exist_ok=True)
    image = f"images/{split}/{stem}.png"
    if not cv2.imwrite(str(folder / image), rgb[:, :, ::-1]):
        raise DetectionError(f"{folder / image}: cannot be written; is the disk full?")
    text = "".join(lines)
    (folder / "labels" / split / f"{stem}.txt").write_text(text, encoding="ascii")
    entry = ManifestEntry(
        image=image,
        split=split,
        group=sample.group,
        origin=sample.origin,
        label_uids=sample.label_uids,
        boxes=tuple(names),
    )
    digest = hashlib.sha256(np.ascontiguousarray(rgb).tobytes() + str(rgb.shape).encode() + text.encode()).hexdigest()
    return entry, digest


def _require_training(entries: Sequence[ManifestEntry]) -> None:
    # generated frames alone teach a project's detector nothing; the base detector learns from nothing else
    own = [entry for entry in entries if entry.origin != GENERATED] or entries
    with_boxes = [entry for entry in own if entry.boxes]
    if not with_boxes:
        raise DetectionError("a training set needs at least one labelled box; label some frames first")
    if all(entry.split == "val" for entry in with_boxes):
        keys = sorted({entry.group.partition("/")[2] or entry.group for entry in with_boxes})
        raise DetectionError(
            f"all labelled frames ({', '.join(keys[:3])}) are among the fifth of the frames that is kept for measuring "
            "and never used for training; label another frame"
        )


def _data_yaml(classes: Sequence[str], measured_on: Split) -> str:
    """Paths are relative to the file, so that the folder can be moved; JSON strings are YAML strings."""
    names = "".join(f"  {number}: {json.dumps(name, ensure_ascii=False)}\n" for number, name in enumerate(classes))
    return f"train: images/train\nval: images/{measured_on}\nnames:\n{names}"


# Cuts images into tiles of the training size, if the detector will see them at a larger size.
#
# Objects in such an image are small: at the training size, they would cover one or two pixels. Tiles show them at the
# size at which the detector will see them. Each image gives one tile around each object and one at a random place. An
# object that is larger than a tile gets a larger tile, which is scaled down.


# An object is labelled on a tile if at least this share of its box lies on it.
MIN_SHARE = 0.3
# Side of the tile around an object that is too large for a normal tile, as a multiple of the object's longer side.
ROOM = 1.15


def tiled(samples: Iterable[TrainingSample], size_px: int) -> Iterator[TrainingSample]:
    """The samples, with each one whose `look_px` exceeds `size_px` replaced by its tiles.

    The positions of the tiles are random, but depend only on the image and its boxes.

    Args:
        size_px: longer side of training images, pixels.
    """
    for sample in samples:
        if sample.look_px <= size_px:
            yield sample
        else:
            yield from _tiles(sample, size_px)


def _tiles(sample: TrainingSample, size_px: int) -> Iterator[TrainingSample]:
    rgb = sample.rgb
    height_px, width_px = rgb.shape[:2]
    scale = sample.look_px / max(height_px, width_px)
    if scale != 1:
        size = (max(round(width_px * scale), 1), max(round(height_px * scale), 1))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    scales = (rgb.shape[1] / width_px, rgb.shape[0] / height_px)  # the size was rounded
    boxes = [(_scaled(box, *scales), uid) for box, uid in zip_longest(sample.boxes, sample.label_uids)]
    rng = np.random.default_rng(list(hashlib.sha256(rgb.tobytes() + repr(sample.boxes).encode()).digest()))
    for box, _ in boxes:
        yield _tile(sample, rgb, boxes, _corner_around(rgb, box, size_px, rng))
    yield _tile(sample, rgb, boxes, _corner_anywhere(rgb, size_px, rng))


def _scaled(box: Box2D, scale_x: float, scale_y: float) -> Box2D:
    """The box on the scaled image. Box edges are measured from the centre of the first pixel, not from its corner."""
    x_min, x_max = ((x + 0.5) * scale_x - 0.5 for x in (box.x_min, box.x_max))
    y_min, y_max = ((y + 0.5) * scale_y - 0.5 for y in (box.y_min, box.y_max))
    return replace(box, x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max)


Corner = tuple[int, int, int]
"""First column and row of a tile, and its side, pixels; a tile is clipped to its image."""


def _corner_around(rgb: UInt8[np.ndarray, "h w 3"], box: Box2D, size_px: int, rng: np.random.Generator) -> Corner:
    """A random tile that contains the visible part of a box; larger than `size_px` if the box is."""
    # the columns and rows that the box touches, as half-open ranges
    edges = ((box.x_min, box.x_max), (box.y_min, box.y_max))
    spans = [(math.floor(low + 0.5), math.ceil(high + 0.5)) for low, high in edges]
    longest = max(end - begin for begin, end in spans)
    side = size_px if longest <= size_px else round(ROOM * longest)
    begins = []
    for (begin, end), length in zip(spans, rgb.shape[1::-1], strict=True):
        first, last = np.clip([end - side, begin], 0, max(length - side, 0))
        begins.append(int(rng.integers(first, last, endpoint=True)))
    return begins[0], begins[1], side


def _corner_anywhere(rgb: UInt8[np.ndarray, "h w 3"], size_px: int, rng: np.random.Generator) -> Corner:
    x, y = (int(rng.integers(0, max(length - size_px, 0), endpoint=True)) for length in rgb.shape[1::-1])
    return x, y, size_px


def _tile(
    sample: TrainingSample, rgb: UInt8[np.ndarray, "h w 3"], boxes: list[tuple[Box2D, str | None]], corner: Corner
) -> TrainingSample:
    x, y, side = corner
    cut = np.ascontiguousarray(rgb[y : y + side, x : x + side])
    shown: list[Box2D] = []
    uids: list[str] = []
    for box, uid in boxes:
        moved = box.shifted(-x, -y)
        if _share_on(cut, moved) >= MIN_SHARE:
            shown.append(moved)
            uids += [] if uid is None else [uid]
    return replace(sample, rgb=cut, boxes=tuple(shown), label_uids=tuple(uids), look_px=0)


def _share_on(rgb: UInt8[np.ndarray, "h w 3"], box: Box2D) -> float:
    """The share of a box's area that lies on the image."""
    cut = clip_to_image(box, rgb.shape[1], rgb.shape[0])
    return 0.0 if cut is None else cut.width_px * cut.height_px / (box.width_px * box.height_px)
