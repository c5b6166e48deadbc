"""Writes a YOLO detection dataset: images, a label file for each, and `data.yaml`.

    images/PART/FILE
    labels/PART/STEM.txt
    data.yaml           path, train, val[, test], names, box_kind, other_box_kind

`path` is written empty: Ultralytics then uses the folder of `data.yaml`, so the dataset can be moved (a relative path
would be resolved against the current directory). `box_kind` is annotator's own: what the boxes of the images enclose,
except of those that `other_box_kind` lists. Source: `check_det_dataset` in its `data/utils.py`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from annotator.formats.dataset_writing import LabelledPicture
from annotator.formats.yolo import dump_boxes
from annotator.types import BoxKind
from annotator.types.errors import ConfigError

PARTS = ("train", "val", "test")
DATA_YAML = "data.yaml"
NO_KINDS: Mapping[str, BoxKind] = MappingProxyType({})


class YoloWriter:
    """Fills a folder with a dataset; without parts, all images are used for training and for validation.

    Raises:
        ConfigError: a part other than train, val and test, or train or val is missing.
    """

    def __init__(self, folder: Path, classes: Sequence[str], parts: Sequence[str] = ()) -> None:
        """
        Args:
            folder: an existing, empty folder.
            classes: numbered from 0 in this order.
            parts: names of all parts, including empty ones; () for a dataset without parts.
        """
        if parts and (not set(parts) <= set(PARTS) or not {"train", "val"} <= set(parts)):
            raise ConfigError(
                f"YOLO's parts are called train, val and (optionally) test, not {', '.join(parts)}; "
                "split the dataset with --split train=0.8,val=0.2"
            )
        self._folder, self._classes = folder, tuple(classes)
        self._numbers = {name: number for number, name in enumerate(classes)}
        self._parts = tuple(part for part in PARTS if part in parts) or ("train",)
        self._kinds: dict[str, BoxKind] = {}
        for part in self._parts:
            for kind in ("images", "labels"):
                (folder / kind / part).mkdir(parents=True)

    def add(self, picture: LabelledPicture) -> None:
        part = picture.part or "train"
        text = dump_boxes(picture.boxes, self._numbers, picture.width_px, picture.height_px)
        (self._folder / "images" / part / picture.file_name).write_bytes(picture.content)
        label = (self._folder / "labels" / part / picture.file_name).with_suffix(".txt")
        label.write_text(text, encoding="ascii")
        self._kinds[picture.file_name] = picture.box_kind

    def finish(self) -> Mapping[str, Path]:
        (self._folder / DATA_YAML).write_text(data_yaml(self._classes, self._parts, self._kinds), encoding="utf-8")
        return {part: self._folder / "images" / part for part in self._parts}


def data_yaml(classes: Sequence[str], parts: Sequence[str], kinds: Mapping[str, BoxKind] = NO_KINDS) -> str:
    """Returns the text of `data.yaml`; without a part `val`, the training images are also used for validation.

    Args:
        kinds: what the boxes of each image enclose.
    """
    import yaml

    folders = {part: part for part in parts} | {"val": "val" if "val" in parts else "train"}
    content = {
        "path": "",
        **{part: f"images/{folders[part]}" for part in PARTS if part in folders},
        "names": dict(enumerate(classes)),
    }
    if kinds:
        ((most, _),) = Counter(kinds.values()).most_common(1)
        content["box_kind"] = most.value
        if others := [name for name, kind in kinds.items() if kind is not most]:
            content["other_box_kind"] = others
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
    return f"# an empty path is the folder of this file\n{text}"


def is_yolo_dataset(folder: Path) -> bool:
    """True for a folder in `YoloWriter`'s layout."""
    return all((folder / name).is_dir() for name in ("images", "labels")) and (folder / DATA_YAML).is_file()
