"""From labelled pictures to a YOLO training set on disk.

The folder holds `images/{train,val}`, `labels/{train,val}` (one text file a picture, `class cx cy w h` as shares of
the picture; an empty file is a background picture), `data.yaml` and `manifest.json`.
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

from annotator.detection.manifest import MANIFEST_NAME, DatasetManifest, ManifestEntry, Split
from annotator.files import new_folder
from annotator.geometry.image_shares import cut_to_picture, shares_of
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ConfigError, DetectionError

JPEG_QUALITY = 95
# A box of which less than this is on the picture is no label, pixels.
MIN_SIDE_PX = 1.0
SPLITS: tuple[Split, Split] = ("train", "val")

Rgb = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """One labelled picture.

    Attributes:
        rgb: (H, W, 3) uint8 in RGB order, or something that gives it when called, or an image file.
        boxes: its labels, in its own pixels; none means that it shows no object.
        group: key of the frame it comes from; pictures of one group are never split between training and measuring.
        origin: how the boxes came about, such as "drawn", "imported" or "projected".
        label_uids: the labels that the boxes come from, as far as these have uids: of the first boxes.
        look_px: longer side, pixels, that a detector will look at it with; 0: with what it is trained at (`tiles`).
    """

    rgb: Rgb | Callable[[], Rgb] | Path
    boxes: tuple[Box2D, ...]
    group: str
    origin: str
    label_uids: tuple[str, ...] = ()
    look_px: int = 0

    def load(self) -> Rgb:
        """The picture.

        Raises:
            DetectionError: its file cannot be read.
        """
        if isinstance(self.rgb, Path):
            bgr = cv2.imread(str(self.rgb), cv2.IMREAD_COLOR)
            if bgr is None:
                raise DetectionError(
                    f"{self.rgb}: training picture cannot be read; remove its labels or restore the file"
                )
            return np.ascontiguousarray(bgr[:, :, ::-1])
        return self.rgb() if callable(self.rgb) else self.rgb


@dataclass(frozen=True)
class _Written:
    """A sample whose files are in the temporary folder."""

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
    val_share: float = 0.2,
    seed: int = 0,
    kind: BoxKind | None = None,
    image_format: Literal["png", "jpg"] = "png",
) -> DatasetManifest:
    """Writes a training set, one picture in memory at a time, and gives its manifest.

    It is written beside `folder` and then renamed, so that `folder` is always whole; an older training set there is
    replaced.

    Args:
        folder: where it shall be; its parents are made.
        samples: at least one of them with a box.
        classes: every class name that may occur; the order numbers them.
        val_share: share of the groups that is held back to measure, 0 to 0.9. With fewer than two groups that have
            boxes none is held back, and the training pictures are measured on (the manifest says so).
        seed: of the split, which depends on it and the group names alone.
        kind: what the boxes measure, recorded in the manifest.
        image_format: png is exact; jpg (quality 95) suits large camera images.

    Raises:
        ConfigError: an unusable class list or share, or a box of an unknown class.
        DetectionError: no box at all, an unreadable picture, or a `folder` that is something else than a training set.
        FormatError: the folder cannot be made.
    """
    _check(folder, classes, val_share)
    with new_folder(folder, lambda _: True) as temporary:  # `_check` has looked at what is there
        written = [
            _write_sample(temporary, f"{index:06d}", sample, classes, image_format)
            for index, sample in enumerate(samples)
        ]
        val_groups = _val_groups(written, val_share, seed)
        for item in written:
            _move(temporary, item, "val" if item.group in val_groups else "train", image_format)
        manifest = _manifest(written, val_groups, classes, val_share, seed, kind, image_format)
        (temporary / MANIFEST_NAME).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")
        (temporary / "data.yaml").write_text(_data_yaml(classes, manifest.measured_on), encoding="utf-8")
    return manifest


def yolo_line(box: Box2D, width_px: int, height_px: int, class_number: int) -> str | None:
    """`class cx cy w h` as shares of the picture, clipped to it; None where nothing of the box is on it."""
    cut = cut_to_picture(box, width_px, height_px, MIN_SIDE_PX)
    if cut is None:
        return None
    return " ".join([str(class_number), *(f"{share:.7f}" for share in shares_of(cut, width_px, height_px))])


def _check(folder: Path, classes: Sequence[str], val_share: float) -> None:
    if not classes or len(set(classes)) != len(classes) or not all(name.strip() for name in classes):
        raise ConfigError(f"the classes of a training set must be different, non-empty names, not {list(classes)}")
    if not 0 <= val_share <= 0.9:
        raise ConfigError(f"the share of groups that is held back must be 0 to 0.9, not {val_share}")
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


def _val_groups(written: Sequence[_Written], val_share: float, seed: int) -> frozenset[str]:
    """The groups that are held back: drawn among those with boxes and those without alike."""
    with_boxes = {item.group for item in written if item.boxes}
    if not with_boxes:
        raise DetectionError("a training set needs at least one labelled box; label some frames first")

    def draw(groups: set[str], most: int) -> list[str]:
        ranked = sorted(groups, key=lambda group: hashlib.sha256(f"{seed}:{group}".encode()).digest())
        wanted = max(round(val_share * len(ranked)), 1) if val_share else 0
        return ranked[: min(wanted, most)]

    held = draw(with_boxes, len(with_boxes) - 1)
    empty = {item.group for item in written} - with_boxes
    return frozenset(held + (draw(empty, len(empty) // 2) if held else []))


def _move(temporary: Path, item: _Written, split: Split, image_format: str) -> None:
    for kind, name in (("images", f"{item.stem}.{image_format}"), ("labels", f"{item.stem}.txt")):
        target = temporary / kind / split
        target.mkdir(parents=True, exist_ok=True)
        (temporary / name).rename(target / name)


def _manifest(
    written: Sequence[_Written],
    val_groups: frozenset[str],
    classes: Sequence[str],
    val_share: float,
    seed: int,
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
        seed=seed,
        val_share=val_share,
        measured_on="val" if val_groups else "train",
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
