"""Reads YOLO detection datasets: `data.yaml` with its image folders, or label files with `classes.txt`.

The label file of an image has the image's name. It is beside the image, or in the folder that results if the last
`images` in the image's path is replaced by `labels`. An image without a label file has no objects. Label files without
an image are also read, since boxes are fractions of the image size. Source: `img2label_paths` and `check_det_dataset`
in Ultralytics' `data/utils.py`.

Nothing outside the dataset's folder is read, even if `data.yaml` or a link points there. If `path` in `data.yaml` is
outside, as in a moved dataset, its parts are looked up beside `data.yaml`.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.file_names import OutsideError, inside, is_within, posix_path, spelled
from annotator.files import why_missing
from annotator.formats.reading import OnFault, known_kind, raise_fault
from annotator.formats.text_folder import read_text
from annotator.formats.yolo import KEYPOINTS, YoloBox, are_keypoints, parse_boxes
from annotator.formats.yolo_dataset import DATA_YAML, PARTS
from annotator.types import BoxKind
from annotator.types.errors import FormatError
from annotator.types.messages import amount, first_problem

CLASSES = "classes.txt"
READABLE = (".png", ".jpg", ".jpeg")
# Image types that Ultralytics also reads; here they are reported as faults.
OTHERS = (".bmp", ".tif", ".tiff", ".webp")
SUFFIXES = READABLE + OTHERS
# Maximum number of characters that a message quotes from an invalid path.
SHOWN = 60


@dataclass(frozen=True)
class YoloPicture:
    """One image of a dataset.

    Attributes:
        file_name: the image's file name without its folder; the label file's if there is no image.
        folder: the folder where the image is or would be.
        picture: the image file; None if only its labels exist.
        label_file: may be missing.
        boxes: in the order of the label file.
        box_kind: what they enclose, if known.
    """

    file_name: str
    folder: Path
    picture: Path | None
    label_file: Path
    boxes: tuple[YoloBox, ...]
    box_kind: BoxKind | None = None


class _DataYaml(BaseModel):
    # other fields (nc, download, ...) are ignored
    model_config = ConfigDict(frozen=True, extra="ignore")

    path: str | None = None
    train: str | list[str] | None = None
    val: str | list[str] | None = None
    test: str | list[str] | None = None
    names: dict[int, str] | list[str]
    box_kind: object = None
    other_box_kind: object = None
    kpt_shape: object = None

    def with_kinds(self, pictures: Iterable[YoloPicture]) -> list[YoloPicture]:
        """Returns the images with what their boxes enclose, if annotator has written it."""
        kind, listed = known_kind(self.box_kind), self.other_box_kind if isinstance(self.other_box_kind, list) else []
        if kind is None:
            return list(pictures)
        other = BoxKind.BOX if kind is BoxKind.SILHOUETTE else BoxKind.SILHOUETTE
        names = {name for name in listed if isinstance(name, str)}
        return [replace(each, box_kind=other if each.file_name in names else kind) for each in pictures]


def read_yolo(path: Path, on_fault: OnFault = raise_fault) -> list[YoloPicture]:
    """Returns all images of a dataset, each once, including those without a box.

    Args:
        path: `data.yaml`; its folder; or a folder of label files with `classes.txt` in it or above it.
        on_fault: called with the fault of a label file or an image of another type; see `OnFault`.

    Raises:
        FormatError: `path` is not one of these, `data.yaml` is damaged, there are keypoints, a part is missing or is
            outside the folder, a label file does not follow the format, or an image is neither PNG nor JPEG.
    """
    if path.is_dir() and not (path / DATA_YAML).is_file():
        pictures = list(_with_classes(path, on_fault))
        _refuse_keypoints(path, pictures, is_said=False)
        return pictures
    file = _inside(path / DATA_YAML, path) if path.is_dir() else path
    data = _read_yaml(file)
    names = data.names if isinstance(data.names, dict) else dict(enumerate(data.names))
    _require_different(file, names)
    root = file.parent
    by_label_file: dict[Path, YoloPicture] = {}
    for part in PARTS:
        value = getattr(data, part)
        for entry in [value] if isinstance(value, str) else value or []:
            for picture in _of_part(_part_path(file, part, data.path, entry), root, names, on_fault):
                by_label_file.setdefault(picture.label_file, picture)
    if not by_label_file:
        raise FormatError(file, "names no image: train, val and test are empty")
    _refuse_keypoints(file, by_label_file.values(), is_said=data.kpt_shape is not None)
    return data.with_kinds(by_label_file.values())


def _refuse_keypoints(path: Path, pictures: Iterable[YoloPicture], *, is_said: bool) -> None:
    around = [box for each in pictures for box in each.boxes if box.is_around]
    if around and (is_said or are_keypoints(around)):
        shown = "kpt_shape" if is_said else f"{amount(len(around), 'row')} with points inside the box"
        raise FormatError(path, KEYPOINTS.format(shown))


def _read_yaml(file: Path) -> _DataYaml:
    import yaml

    try:
        return _DataYaml.model_validate(yaml.safe_load(read_text(file)))
    except yaml.MarkedYAMLError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        raise FormatError(file, f"is not valid YAML: {error.problem}", line) from error
    except ValidationError as error:
        raise FormatError(
            file,
            f"{first_problem(error)}; write class names and paths as text, in quotes if YAML reads them as numbers",
        ) from error
    # a wrong type tag (`!!int x`) makes PyYAML raise errors that it does not document
    except (
        yaml.YAMLError,
        RecursionError,
        ValueError,
        LookupError,
        AttributeError,
        TypeError,
        ArithmeticError,
    ) as error:
        raise FormatError(file, f"is not valid YAML ({error})") from error


def _require_different(file: Path, names: Mapping[int, str]) -> None:
    if not names or len(set(names.values())) != len(names) or not all(names.values()) or min(names) < 0:
        raise FormatError(file, f"names must be unique and not empty, numbered from 0, not {dict(names)}"[:200])


def _part_path(file: Path, part: str, base: str | None, entry: str) -> Path:
    """Returns the image folder or image list that a part's entry names."""
    root = file.parent
    name = posix_path(entry)
    outside: OutsideError | None = None
    is_inside = False
    # some services export ../train/images where train/images is right
    for candidate in (str(PurePosixPath(posix_path(base or "")) / name), entry, name.removeprefix("../")):
        try:
            place = inside(root, candidate)
        except OutsideError as error:
            outside = outside or error
            continue
        is_inside = True
        if place.exists() or _inside(_labels_of(place, root), root).is_dir():
            return place
    if is_inside:
        raise FormatError(file, f"{part}: there is no {entry[:SHOWN]!r} in the dataset's folder")
    raise FormatError(file, f"{part}: {outside}")


def _inside(path: Path, root: Path) -> Path:
    """Returns the path unchanged.

    Raises:
        FormatError: the path is, or is behind, a link that leads out of the dataset's folder.
    """
    if not is_within(root, path):
        raise FormatError(path, "is a link that leads out of the dataset's folder; copy the file itself there")
    return path


def _labels_of(path: Path, root: Path) -> Path:
    """Returns the label path of an image, or the label folder of an image folder."""
    parts = list(path.resolve().relative_to(root.resolve()).parts)
    if "images" in parts:
        parts[len(parts) - 1 - parts[::-1].index("images")] = "labels"
    return root.resolve().joinpath(*parts)


def _label_file(picture: Path, root: Path) -> Path:
    """Returns the label file of an image, in the Unicode form in which its name exists."""
    path = _labels_of(picture, root).with_suffix(".txt")
    return spelled(path.parent, path.name)


def _of_part(place: Path, root: Path, names: Mapping[int, str], on_fault: OnFault) -> Iterator[YoloPicture]:
    if place.is_file():
        yield from (_read(picture, root, names, on_fault) for picture in _listed(place, root))
        return
    pictures = sorted(each for each in place.rglob("*") if each.suffix.lower() in SUFFIXES)
    for picture in pictures:
        yield _read(_inside(picture, root), root, names, on_fault)
    seen = {_label_file(picture, root) for picture in pictures}
    labels = _inside(_labels_of(place, root), root)
    for label_file in sorted(labels.rglob("*.txt")) if labels.is_dir() else []:
        if label_file not in seen and label_file.name != CLASSES:
            yield _labels_without_image(_inside(label_file, root), place, names, on_fault)


def _listed(file: Path, root: Path) -> Iterator[Path]:
    """Yields the images that a text file lists, one per line."""
    for line, text in enumerate(read_text(file).splitlines(), 1):
        if not (name := text.strip()):
            continue
        # a name that begins with a point is relative to the list
        below = os.path.relpath(file.parent, root) + "/" if posix_path(name).startswith("./") else ""
        try:
            yield inside(root, below + name)
        except OutsideError as error:
            raise FormatError(file, str(error), line) from error


def _read(picture: Path, root: Path, names: Mapping[int, str], on_fault: OnFault) -> YoloPicture:
    if picture.is_file():
        _require_readable(picture, on_fault)
    label_file = _inside(_label_file(picture, root), root)
    boxes = _boxes(label_file, names, on_fault) if label_file.is_file() else ()
    return YoloPicture(picture.name, picture.parent, picture if picture.is_file() else None, label_file, boxes)


def _require_readable(picture: Path, on_fault: OnFault) -> None:
    if picture.suffix.lower() in OTHERS:
        on_fault(
            FormatError(picture, "only PNG and JPEG images are supported; save it as PNG or JPEG under the same name")
        )


def _boxes(label_file: Path, names: Mapping[int, str], on_fault: OnFault) -> tuple[YoloBox, ...]:
    try:
        text = read_text(label_file)
    except FormatError as fault:
        on_fault(fault)
        return ()
    return parse_boxes(label_file, text, names, on_fault)


def _labels_without_image(label_file: Path, folder: Path, names: Mapping[int, str], on_fault: OnFault) -> YoloPicture:
    return YoloPicture(label_file.name, folder, None, label_file, _boxes(label_file, names, on_fault))


def _with_classes(folder: Path, on_fault: OnFault) -> Iterator[YoloPicture]:
    """Yields the images of a folder of label files with `classes.txt`, one class name per line."""
    # the given folder itself may be a link; links inside it are checked
    folder = folder.resolve()
    file = next((each / CLASSES for each in (folder, folder.parent) if (each / CLASSES).is_file()), None)
    if file is None:
        raise FormatError(folder, f"is not a YOLO dataset: it has no {DATA_YAML}, and no {CLASSES} beside label files")
    _inside(file, file.parent)
    names = {number: name.strip() for number, name in enumerate(read_text(file).rstrip().splitlines())}
    _require_different(file, names)
    labels = folder / "labels" if (folder / "labels").is_dir() else folder
    root = labels.parent if labels.name == "labels" else labels
    # images are beside the labels, or in `images` beside `labels`
    image_roots = [labels, *([labels.with_name("images")] if labels.name == "labels" else [])]
    label_files = sorted(each for each in _inside(labels, root).rglob("*.txt") if each.name != CLASSES)
    if not label_files:
        raise FormatError(labels, "has no label file (*.txt)")
    for label_file in label_files:
        folders = [each / label_file.parent.relative_to(labels) for each in image_roots]
        candidates = [spelled(each, f"{label_file.stem}{suffix}") for each in folders for suffix in SUFFIXES]
        picture = next(
            (_inside(each, root) for each in candidates if why_missing(each) is None and each.is_file()), None
        )
        if picture is not None:
            _require_readable(picture, on_fault)
        boxes = _boxes(_inside(label_file, root), names, on_fault)
        place = folders[-1] if picture is None else picture.parent
        yield YoloPicture((picture or label_file).name, place, picture, label_file, boxes)
