"""Reads YOLO detection datasets: `data.yaml` with its folders of pictures, or label files with `classes.txt`.

A picture's label file has its name and lies where the last `images` of its path reads `labels`, or beside it where
there is none; a picture without one shows nothing. Labels without their pictures are taken, too: their boxes are shares
of whatever size the picture has. Source: `img2label_paths` and `check_det_dataset` in Ultralytics' `data/utils.py`.

Nothing outside the dataset's folder is read, whatever `data.yaml` says and links name; where its `path` leads
elsewhere, as in a dataset that was moved, its parts are looked for beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.files import is_within, why_missing
from annotator.formats.faults import Tell, give_up
from annotator.formats.json_file import first_problem
from annotator.formats.text_folder import read_text
from annotator.formats.yolo import YoloBox, parse_boxes
from annotator.formats.yolo_dataset import DATA_YAML, PARTS
from annotator.types.errors import FormatError

CLASSES = "classes.txt"
READABLE = (".png", ".jpg", ".jpeg")
# Ultralytics takes these, too; here they are told, and not passed over.
OTHERS = (".bmp", ".tif", ".tiff", ".webp")
SUFFIXES = READABLE + OTHERS
LEADS_OUT = "leads out of the dataset's folder, or is no name"
# Of a name that is none.
SHOWN = 60


@dataclass(frozen=True)
class YoloPicture:
    """One picture of a dataset.

    Attributes:
        file_name: without its folder; of the label file where there is no picture.
        folder: where the picture is, or would be.
        picture: the image file; None where only its labels are there.
        label_file: which may be missing.
        boxes: in the order of the label file.
    """

    file_name: str
    folder: Path
    picture: Path | None
    label_file: Path
    boxes: tuple[YoloBox, ...]


class _DataYaml(BaseModel):
    # files of other tools say more (nc, download, ...)
    model_config = ConfigDict(frozen=True, extra="ignore")

    path: str | None = None
    train: str | list[str] | None = None
    val: str | list[str] | None = None
    test: str | list[str] | None = None
    names: dict[int, str] | list[str]


def read_yolo(path: Path, tell: Tell = give_up) -> list[YoloPicture]:
    """All pictures of a dataset, each once, those without a box too.

    Args:
        path: `data.yaml`; the folder that it lies in; or a folder of label files with `classes.txt` in it or above it.
        tell: what becomes of a fault in a label file, and of a picture of another kind.

    Raises:
        FormatError: none of these, a damaged `data.yaml`, a part that is not there or leads out of the folder, a
            label file that does not follow the format, or a picture that is there and neither PNG nor JPEG.
    """
    if path.is_dir() and not (path / DATA_YAML).is_file():
        return list(_with_classes(path, tell))
    file = _inside(path / DATA_YAML, path) if path.is_dir() else path
    data = _read_yaml(file)
    names = data.names if isinstance(data.names, dict) else dict(enumerate(data.names))
    _require_different(file, names)
    root = file.parent
    found: dict[Path, YoloPicture] = {}
    for part in PARTS:
        value = getattr(data, part)
        for entry in [value] if isinstance(value, str) else value or []:
            for picture in _of_part(_placed(file, part, data.path, entry), root, names, tell):
                found.setdefault(picture.label_file, picture)
    if not found:
        raise FormatError(file, "names no picture: train, val and test are empty")
    return list(found.values())


def _read_yaml(file: Path) -> _DataYaml:
    import yaml

    try:
        return _DataYaml.model_validate(yaml.safe_load(read_text(file)))
    except yaml.MarkedYAMLError as error:
        line = None if error.problem_mark is None else error.problem_mark.line + 1
        raise FormatError(file, f"is not valid YAML: {error.problem}", line) from error
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        if isinstance(error, ValidationError):
            raise FormatError(file, f"{first_problem(error)}; names must be texts, in quotes if need be") from error
        raise FormatError(file, f"is not valid YAML ({error})") from error


def _require_different(file: Path, names: Mapping[int, str]) -> None:
    if not names or len(set(names.values())) != len(names) or not all(names.values()) or min(names) < 0:
        raise FormatError(file, f"names must be different texts, numbered from 0, not {dict(names)}"[:200])


def _placed(file: Path, part: str, base: str | None, entry: str) -> Path:
    """The folder or list of pictures that a part's entry names."""
    root = file.parent
    # exports of some services write ../train/images and mean train/images
    candidates = [root / (base or "") / entry, root / entry, root / entry.removeprefix("../")]
    inside = [candidate for candidate in candidates if is_within(root, candidate)]
    for candidate in inside:
        if candidate.exists() or _inside(_labels_of(candidate, root), root).is_dir():
            return candidate
    if not inside:
        raise FormatError(file, f"{part}: {entry[:SHOWN]!r} {LEADS_OUT}; use a path within it")
    raise FormatError(file, f"{part}: there is no {entry[:SHOWN]!r} in the dataset's folder")


def _inside(path: Path, root: Path) -> Path:
    """The path itself, which may be read.

    Raises:
        FormatError: it is, or lies behind, a link that leads out of the dataset's folder.
    """
    if not is_within(root, path):
        raise FormatError(path, f"is a link that {LEADS_OUT}; put the file itself there")
    return path


def _labels_of(path: Path, root: Path) -> Path:
    """The place of labels for a picture's, or for a folder of pictures'."""
    parts = list(path.resolve().relative_to(root.resolve()).parts)
    if "images" in parts:
        parts[len(parts) - 1 - parts[::-1].index("images")] = "labels"
    return root.resolve().joinpath(*parts)


def _of_part(place: Path, root: Path, names: Mapping[int, str], tell: Tell) -> Iterator[YoloPicture]:
    if place.is_file():
        yield from (_read(picture, root, names, tell) for picture in _listed(place, root))
        return
    pictures = sorted(each for each in place.rglob("*") if each.suffix.lower() in SUFFIXES)
    for picture in pictures:
        yield _read(_inside(picture, root), root, names, tell)
    seen = {_labels_of(picture, root).with_suffix(".txt") for picture in pictures}
    labels = _inside(_labels_of(place, root), root)
    for label_file in sorted(labels.rglob("*.txt")) if labels.is_dir() else []:
        if label_file not in seen and label_file.name != CLASSES:
            yield _labels_alone(_inside(label_file, root), place, names, tell)


def _listed(file: Path, root: Path) -> Iterator[Path]:
    """The pictures that a text file names, one a line."""
    for line, text in enumerate(read_text(file).splitlines(), 1):
        if not (name := text.strip()):
            continue
        picture = (file.parent if name.startswith("./") else root) / PurePosixPath(name)
        if not is_within(root, picture):
            raise FormatError(file, f"{name[:SHOWN]!r} {LEADS_OUT}", line)
        yield picture


def _read(picture: Path, root: Path, names: Mapping[int, str], tell: Tell) -> YoloPicture:
    if picture.is_file():
        _require_readable(picture, tell)
    label_file = _inside(_labels_of(picture, root).with_suffix(".txt"), root)
    boxes = _boxes(label_file, names, tell) if label_file.is_file() else ()
    return YoloPicture(picture.name, picture.parent, picture if picture.is_file() else None, label_file, boxes)


def _require_readable(picture: Path, tell: Tell) -> None:
    if picture.suffix.lower() in OTHERS:
        tell(FormatError(picture, "only PNG and JPEG pictures are read; save it as one of them, beside its labels"))


def _boxes(label_file: Path, names: Mapping[int, str], tell: Tell) -> tuple[YoloBox, ...]:
    try:
        text = read_text(label_file)
    except FormatError as fault:
        tell(fault)
        return ()
    return parse_boxes(label_file, text, names, tell)


def _labels_alone(label_file: Path, folder: Path, names: Mapping[int, str], tell: Tell) -> YoloPicture:
    return YoloPicture(label_file.name, folder, None, label_file, _boxes(label_file, names, tell))


def _with_classes(folder: Path, tell: Tell) -> Iterator[YoloPicture]:
    """Label files with their class names in `classes.txt`, one a line."""
    # a link to the folder is its user's choice, one within it is not
    folder = folder.resolve()
    file = next((each / CLASSES for each in (folder, folder.parent) if (each / CLASSES).is_file()), None)
    if file is None:
        raise FormatError(folder, f"has no {DATA_YAML}, and no {CLASSES} beside label files; it is no YOLO dataset")
    _inside(file, file.parent)
    names = {number: name.strip() for number, name in enumerate(read_text(file).rstrip().splitlines())}
    _require_different(file, names)
    labels = folder / "labels" if (folder / "labels").is_dir() else folder
    root = labels.parent if labels.name == "labels" else labels
    # beside the labels, or in `images` beside `labels`
    homes = [labels, *([labels.with_name("images")] if labels.name == "labels" else [])]
    found = sorted(each for each in _inside(labels, root).rglob("*.txt") if each.name != CLASSES)
    if not found:
        raise FormatError(labels, "has no label file (*.txt)")
    for label_file in found:
        folders = [home / label_file.parent.relative_to(labels) for home in homes]
        candidates = [each / f"{label_file.stem}{suffix}" for each in folders for suffix in SUFFIXES]
        picture = next(
            (_inside(each, root) for each in candidates if why_missing(each) is None and each.is_file()), None
        )
        if picture is not None:
            _require_readable(picture, tell)
        boxes = _boxes(_inside(label_file, root), names, tell)
        place = folders[-1] if picture is None else picture.parent
        yield YoloPicture((picture or label_file).name, place, picture, label_file, boxes)
