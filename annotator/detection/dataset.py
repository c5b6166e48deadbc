"""Writes labelled images as a YOLO training set.

The folder holds `images/{train,val}`, `labels/{train,val}` (one text file per image, `class cx cy w h` as shares of the
image size; an empty file marks a background image), `data.yaml` and `manifest.json`.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import UInt8

from annotator.detection.held_out import is_held_out
from annotator.detection.manifest import MANIFEST_NAME, DatasetManifest, ManifestEntry, Split
from annotator.files import new_folder
from annotator.geometry.outline import clip_to_image, shares_of
from annotator.image_bytes import read_image
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ConfigError, DetectionError

JPEG_QUALITY = 95
# Boxes whose part inside the image has a shorter side are dropped, pixels.
MIN_SIDE_PX = 1.0
# Origin of the boxes on views of generated frames.
GENERATED = "generated"
SPLITS: tuple[Split, Split] = ("train", "val")

Rgb = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """One labelled image.

    Attributes:
        rgb: (H, W, 3) uint8 in RGB order, a function that returns it, or an image file.
        boxes: its labels, in pixels of this image; empty if no object is visible.
        group: key of the source frame; images of one group are never split between training and validation.
        origin: where the boxes come from, such as "drawn", "imported" or "projected".
        label_uids: uids of the source labels, for the first boxes; may be shorter than `boxes`.
        look_px: longer side at which the detector will see this image, pixels; 0: the training size (see `tiles`).
    """

    rgb: Rgb | Callable[[], Rgb] | Path
    boxes: tuple[Box2D, ...]
    group: str
    origin: str
    label_uids: tuple[str, ...] = ()
    look_px: int = 0

    def load(self) -> Rgb:
        """The image as an array.

        Raises:
            DetectionError: the file cannot be read.
        """
        if isinstance(self.rgb, Path):
            try:
                bgr = read_image(self.rgb, cv2.IMREAD_COLOR)
            except (OSError, ValueError) as error:
                raise DetectionError(
                    f"{self.rgb}: training image cannot be read ({error}); restore the file or remove its labels"
                ) from error
            return np.ascontiguousarray(bgr[:, :, ::-1])
        return self.rgb() if callable(self.rgb) else self.rgb


@dataclass(frozen=True)
class _Written:
    """A sample that has been written to the temporary folder."""

    stem: str
    group: str
    origin: str
    label_uids: tuple[str, ...]
    boxes: tuple[str, ...]
    dropped: int
    digest: str


def write_dataset(
    folder: Path,
    samples: Iterable[TrainingSample],
    classes: Sequence[str],
    is_held_out: Callable[[str], bool] = is_held_out,
    kind: BoxKind | None = None,
    image_format: Literal["png", "jpg"] = "png",
) -> DatasetManifest:
    """Writes a training set, with one image in memory at a time, and returns its manifest.

    The set is written beside `folder` and then renamed, so `folder` is never incomplete. An existing training set is
    replaced.

    Args:
        folder: the new folder; missing parents are created.
        samples: at least one of them must have a box.
        classes: all class names, in the order of the class numbers.
        is_held_out: whether a group's images validate; the others train. If no group with boxes validates, the
            training images are used for validation, and the manifest records this.
        kind: what the boxes measure; recorded in the manifest.
        image_format: png is lossless; jpg (quality 95) suits large camera images.

    Raises:
        ConfigError: an invalid class list, or a box of an unknown class.
        DetectionError: there is no box to train on, an image is unreadable, or `folder` is not a training set.
        FormatError: the folder cannot be created.
    """
    _check(folder, classes)
    with new_folder(folder, lambda _: True) as temporary:  # `_check` refuses any other folder
        written = [
            _write_sample(temporary, f"{index:06d}", sample, classes, image_format)
            for index, sample in enumerate(samples)
        ]
        val_groups = _val_groups(written, is_held_out)
        for item in written:
            _move(temporary, item, "val" if item.group in val_groups else "train", image_format)
        manifest = _manifest(written, val_groups, classes, kind, image_format)
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
    temporary: Path, stem: str, sample: TrainingSample, classes: Sequence[str], image_format: str
) -> _Written:
    rgb = sample.load()
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
    picture = temporary / f"{stem}.{image_format}"
    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if image_format == "jpg" else []
    if not cv2.imwrite(str(picture), rgb[:, :, ::-1], quality):
        raise DetectionError(f"{picture}: cannot be written; is the disk full?")
    text = "".join(lines)
    (temporary / f"{stem}.txt").write_text(text, encoding="ascii")
    digest = hashlib.sha256(np.ascontiguousarray(rgb).tobytes() + str(rgb.shape).encode() + text.encode()).hexdigest()
    dropped = len(sample.boxes) - len(lines)
    return _Written(stem, sample.group, sample.origin, sample.label_uids, tuple(names), dropped, digest)


def _val_groups(written: Sequence[_Written], is_held_out: Callable[[str], bool]) -> frozenset[str]:
    """The held-out groups.

    Raises:
        DetectionError: no other group has boxes.
    """
    # generated frames alone teach a project's detector nothing; the base detector learns from nothing else
    own = [item for item in written if item.origin != GENERATED] or written
    with_boxes = {item.group for item in own if item.boxes}
    if not with_boxes:
        raise DetectionError("a training set needs at least one labelled box; label some frames first")
    held_out = frozenset(group for group in {item.group for item in written} if is_held_out(group))
    if with_boxes <= held_out:
        keys = sorted(group.partition("/")[2] or group for group in with_boxes)
        raise DetectionError(
            f"all labelled frames ({', '.join(keys[:3])}) are among the fifth of the frames that is kept for measuring "
            "and never used for training; label another frame"
        )
    return held_out


def _move(temporary: Path, item: _Written, split: Split, image_format: str) -> None:
    for kind, name in (("images", f"{item.stem}.{image_format}"), ("labels", f"{item.stem}.txt")):
        target = temporary / kind / split
        target.mkdir(parents=True, exist_ok=True)
        (temporary / name).rename(target / name)


def _manifest(
    written: Sequence[_Written],
    val_groups: frozenset[str],
    classes: Sequence[str],
    kind: BoxKind | None,
    image_format: str,
) -> DatasetManifest:
    entries = []
    digest = hashlib.sha256(json.dumps([list(classes), kind], ensure_ascii=False).encode())
    for item in written:
        split: Split = "val" if item.group in val_groups else "train"
        image = f"images/{split}/{item.stem}.{image_format}"
        digest.update(f"{split} {item.digest}\n".encode())
        entries.append(
            ManifestEntry(
                image=image,
                split=split,
                group=item.group,
                origin=item.origin,
                label_uids=item.label_uids,
                boxes=item.boxes,
            )
        )
    by_split = {split: [entry for entry in entries if entry.split == split] for split in SPLITS}
    return DatasetManifest(
        sha256=digest.hexdigest(),
        classes=tuple(classes),
        kind=kind,
        measured_on="val" if any(entry.boxes for entry in by_split["val"]) else "train",
        images={split: len(by_split[split]) for split in SPLITS},
        boxes_by_class={
            split: {name: sum(entry.boxes.count(name) for entry in by_split[split]) for name in classes}
            for split in SPLITS
        },
        images_by_origin={
            split: dict(sorted(Counter(entry.origin for entry in by_split[split]).items())) for split in SPLITS
        },
        dropped_boxes=sum(item.dropped for item in written),
        entries=tuple(entries),
    )


def _data_yaml(classes: Sequence[str], measured_on: Split) -> str:
    """Paths are relative to the file, so that the folder can be moved; JSON strings are YAML strings."""
    names = "".join(f"  {number}: {json.dumps(name, ensure_ascii=False)}\n" for number, name in enumerate(classes))
    return f"train: images/train\nval: images/{measured_on}\nnames:\n{names}"
