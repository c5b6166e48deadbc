"""YOLO label files of 2D boxes: one text file per image, one line per box.

    CLASS CX CY W H [SCORE]
    CLASS X1 Y1 X2 Y2 X3 Y3 [X4 Y4 ...]
    CLASS CX CY W H X1 Y1 [VISIBILITY1] X2 Y2 [VISIBILITY2] ...

The second form is a turned box, by its four corners, or a polygon; it is read as the rectangle around these. The
third form has keypoints, which are not read; all rows of a dataset together show it (`are_keypoints`). The class is an
index into the dataset's `names`, from 0. Centre, width, height and corners are fractions of the image size,
measured from the image's corner (see `geometry/outline.py`). An empty file means an image without objects. A sixth
field is the score of a detection. Source: Ultralytics' documentation, overviews of datasets for "object detection",
"oriented bounding box" and "instance segmentation", and the checks in its `data/utils.py`.

A dataset has images, a label file for each, and `data.yaml`, or label files with `classes.txt`:

    images/PART/FILE
    labels/PART/STEM.txt
    data.yaml           path, train, val[, test], names, box_kind, other_box_kind

The label file is beside the image, or in the folder that results if the last `images` in the image's path is replaced
by `labels`. An image without one has no objects. Label files without an image are read, too, since boxes are fractions
of the image size. Nothing outside the dataset's folder is read, even if `data.yaml` or a link points there. If `path`
in `data.yaml` is outside, as in a moved dataset, its parts are looked up beside `data.yaml`. An empty `path` is
written: Ultralytics then uses the folder of `data.yaml`, so the dataset can be moved. `box_kind` is annotator's own:
what the boxes of the images enclose, except of those that `other_box_kind` lists. Source: `img2label_paths` and
`check_det_dataset`.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64
from pydantic import ValidationError

from annotator.formats.dataset_writing import PictureWriter
from annotator.formats.frame_names import PictureLabels, YoloBox, has_frames
from annotator.formats.reading import OnFault, known_kind, raise_fault, read_text, reported
from annotator.geometry.outline import shares_of
from annotator.text import NAME_SHOWN, SHOWN, OutsideError, inside, is_within, posix_path, spelled, to_number
from annotator.types import Box2D, BoxKind
from annotator.types.bases import FileRecord
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import amount, first_problem

# Ultralytics accepts boxes that extend beyond the image by this fraction of its size.
TOLERANCE = 0.01
FIELDS = "class cx cy w h"
# Numbers of a row after the class: a box, and with a score; and the corners of the least polygon.
BOX_NUMBERS, LEAST_CORNERS = (4, 5), 6
KEYPOINTS = "has keypoints ({}), which are not supported; keep the first five fields of rows"
# Numbers of a keypoint without and with its visibility: 0 = not labelled, 1 = hidden, 2 = visible.
POINT_NUMBERS, VISIBILITIES = (2, 3), (0, 1, 2)
# Distance of a box's size, read as a place, from its centre and points, of which there is one, or several; in sides of
# the rectangle around these. Triangles may be thin.
FAR = (6, 1)
# Rows that show that their boxes are full of points; a single polygon may do so by chance.
LEAST_FULL = 2
# Share of each side of such a box that its points cover, and distance of the box's centre from the edges of the points.
FULL, INNER = 0.5, 0.05


def dump_boxes(boxes: Sequence[Box2D], numbers: Mapping[str, int], width_px: int, height_px: int) -> str:
    """Returns the text of a label file, without scores, as training files have none.

    Args:
        boxes: within the image.
        numbers: class numbers by name.
    """
    lines = []
    for box in boxes:
        shares = shares_of(box, width_px, height_px)
        lines.append(" ".join([str(numbers[box.label]), *(f"{share:.7f}" for share in shares)]) + "\n")
    return "".join(lines)


def parse_boxes(
    path: Path, text: str, names: Mapping[int, str], on_fault: OnFault = raise_fault
) -> tuple[YoloBox, ...]:
    """Returns the boxes of a label file in file order.

    Args:
        names: class names by number.
    """
    boxes: dict[YoloBox, int] = {}
    for line, row in enumerate(text.splitlines(), 1):
        if not row.strip():
            continue
        with reported(on_fault):
            box = _box(path, line, row.split(), names)
            if box in boxes:
                raise FormatError(path, f"the same box as in line {boxes[box]}; keep one of them", line)
            boxes[box] = line
    return tuple(boxes)


def _box(path: Path, line: int, fields: list[str], names: Mapping[int, str]) -> YoloBox:
    is_box = len(fields) - 1 in BOX_NUMBERS
    if not is_box and (len(fields) - 1 < LEAST_CORNERS or len(fields) % 2 == 0):
        raise FormatError(
            path,
            f"has {len(fields)} fields; a box has {FIELDS} [score], a turned box or a polygon has class x1 y1 x2 y2 x3 "
            "y3 ..., and keypoints are not supported",
            line,
        )
    if not fields[0].removeprefix("-").isdecimal():
        raise FormatError(
            path, f"must hold numbers ({FIELDS}); {fields[0][:SHOWN]!r} is not the number of a class", line
        )
    try:
        class_number, numbers = int(fields[0]), list(map(to_number, fields[1:]))
    except ValueError as error:
        raise FormatError(path, f"must hold numbers ({FIELDS}): {error}", line) from None
    if class_number not in names:
        raise FormatError(
            path, f"class {class_number} has no name; classes with a name go from 0 to {max(names, default=-1)}", line
        )
    if not all(map(math.isfinite, numbers)):
        raise FormatError(path, "all numbers must be finite", line)
    cx, cy, w, h = numbers[:4] if is_box else _around(numbers)
    score = numbers[4] if len(numbers) == 5 else 1.0
    if not 0 <= score <= 1:
        raise FormatError(path, f"the score must be in 0..1, not {score:g}", line)
    edges = (cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2)
    # a visibility of 2 is no place in the image
    if not is_box and max(edges) > 1 + TOLERANCE and _are_keypoints(np.array([numbers]), max(POINT_NUMBERS)):
        raise FormatError(path, KEYPOINTS.format("cx cy w h x y visibility ..."), line)
    if min(w, h) <= 0 or min(edges) < -TOLERANCE or max(edges) > 1 + TOLERANCE:
        raise FormatError(
            path,
            f"cx cy w h must be fractions of the image size that describe a non-empty box inside the image, not "
            f"{cx:g} {cy:g} {w:g} {h:g}",
            line,
        )
    # a smaller box has no extent once it is clipped to an image of any size
    if min(edges[2], 1) - max(edges[0], 0) < 1e-9 or min(edges[3], 1) - max(edges[1], 0) < 1e-9:
        raise FormatError(path, "the box is outside the image", line)
    corners = () if is_box else tuple(numbers)
    return YoloBox(names[class_number], (cx, cy, w, h), score, not is_box, corners)


def _around(corners: Sequence[float]) -> tuple[float, float, float, float]:
    """Returns cx, cy, w, h of the rectangle around the corners x1 y1 x2 y2 ..."""
    left, right, top, bottom = min(corners[::2]), max(corners[::2]), min(corners[1::2]), max(corners[1::2])
    return (left + right) / 2, (top + bottom) / 2, right - left, bottom - top


def are_keypoints(boxes: Iterable[YoloBox]) -> bool:
    """True if the rows that were read as polygons are boxes with keypoints.

    All rows must have the same number of points, and their first four numbers must be a box that holds all points
    behind it. Small polygons may look so, too. But a polygon's second corner is near the others, where the second pair
    of a box is its size; and a polygon's first corner is seldom in the middle of the others.
    """
    rows = [box.corners for box in boxes if box.corners]
    if len(set(map(len, rows))) != 1:
        return False
    table = np.array(rows)
    return any(_are_keypoints(table, numbers) for numbers in POINT_NUMBERS)


def _are_keypoints(rows: Float64[np.ndarray, "n c"], numbers: int) -> bool:
    if (rows.shape[1] - 4) % numbers:
        return False
    centers, sizes = rows[:, None, :2], rows[:, None, 2:4]
    points = rows[:, 4:].reshape(len(rows), -1, numbers)
    xy, visibilities = points[..., :2], points[..., 2:]
    if not np.isin(visibilities, VISIBILITIES).all():
        return False
    # tools write 0 0 for points that are not labelled
    missing = (xy == 0).all(axis=2) | (visibilities == 0).any(axis=2)
    low, high = centers - sizes / 2 - TOLERANCE, centers + sizes / 2 + TOLERANCE
    is_held = ((xy >= low) & (xy <= high)).all(axis=2) | missing
    if not (is_held.all() and (sizes > 0).all() and low.min() >= -2 * TOLERANCE and high.max() <= 1 + 2 * TOLERANCE):
        return False
    if numbers == max(POINT_NUMBERS):
        return True
    xy = np.where(missing[..., None], centers, xy)
    first, last = np.minimum(xy.min(axis=1), centers[:, 0]), np.maximum(xy.max(axis=1), centers[:, 0])
    beside = np.maximum(first - sizes[:, 0], sizes[:, 0] - last).max(axis=1)
    is_far = (beside > FAR[xy.shape[1] > 1] * (last - first).max(axis=1)) & ~missing.all(axis=1)
    sides, inner = xy.max(axis=1) - xy.min(axis=1), centers[:, 0]
    is_inner = (inner > xy.min(axis=1) + INNER * sides) & (inner < xy.max(axis=1) - INNER * sides)
    is_full = (is_inner & (sides >= FULL * sizes[:, 0])).all(axis=1)
    return bool(is_far.mean() > 0.5 or (len(rows) >= LEAST_FULL and is_full.mean() > 0.5))


PARTS = ("train", "val", "test")
DATA_YAML = "data.yaml"


class YoloWriter(PictureWriter):
    """Numbers the classes from 0; without parts, all images are used for training and for validation."""

    def __init__(self, folder: Path, classes: Sequence[str], parts: Sequence[str] = ()) -> None:
        if parts and (not set(parts) <= set(PARTS) or not {"train", "val"} <= set(parts)):
            raise ConfigError(
                f"YOLO's parts are called train, val and (optionally) test, not {', '.join(parts)}; "
                "split the dataset with --split train=0.8,val=0.2"
            )
        super().__init__(folder, classes, tuple(part for part in PARTS if part in parts) or ("train",))
        self._numbers = {name: number for number, name in enumerate(classes)}
        self._kinds: dict[str, BoxKind] = {}
        for part in self.parts:
            for kind in ("images", "labels"):
                (folder / kind / part).mkdir(parents=True)

    def add(self, picture: PictureLabels, content: bytes, part: str | None = None) -> None:
        assert picture.size_px is not None
        text = dump_boxes(picture.boxes_on(*picture.size_px), self._numbers, *picture.size_px)
        place = f"{part or 'train'}/{picture.file_name}"
        self.put(f"images/{place}", content)
        self.put(str(Path("labels", place).with_suffix(".txt")), text)
        if picture.box_kind is not None:
            self._kinds[picture.file_name] = picture.box_kind

    def finish(self) -> Mapping[str, Path]:
        """Writes `data.yaml`; without a part `val`, the training images are also used for validation."""
        import yaml

        folders = {part: part for part in self.parts} | {"val": "val" if "val" in self.parts else "train"}
        content: dict[str, object] = {
            "path": "",
            **{part: f"images/{folders[part]}" for part in PARTS if part in folders},
            "names": dict(enumerate(self.classes)),
        }
        if self._kinds:
            ((most, _),) = Counter(self._kinds.values()).most_common(1)
            content["box_kind"] = most.value
            if others := [name for name, kind in self._kinds.items() if kind is not most]:
                content["other_box_kind"] = others
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        self.put(DATA_YAML, f"# an empty path is the folder of this file\n{text}")
        return {part: self.folder / "images" / part for part in self.parts}


CLASSES = "classes.txt"
READABLE = (".png", ".jpg", ".jpeg")
# Image types that Ultralytics also reads; here they are reported as faults.
OTHERS = (".bmp", ".tif", ".tiff", ".webp")
SUFFIXES = READABLE + OTHERS


def is_yolo_export(folder: Path) -> bool:
    """True for a folder that annotator has exported in this format; those of other formats may have a `classes.txt`."""
    return has_frames(folder) and (folder / DATA_YAML).is_file()


class _DataYaml(FileRecord):
    path: str | None = None
    train: str | list[str] | None = None
    val: str | list[str] | None = None
    test: str | list[str] | None = None
    names: dict[int, str] | list[str]
    box_kind: object = None
    other_box_kind: object = None
    kpt_shape: object = None

    def with_kinds(self, pictures: Iterable[PictureLabels]) -> list[PictureLabels]:
        """Returns the images with what their boxes enclose, if annotator has written it."""
        kind, listed = known_kind(self.box_kind), self.other_box_kind if isinstance(self.other_box_kind, list) else []
        if kind is None:
            return list(pictures)
        other = BoxKind.BOX if kind is BoxKind.SILHOUETTE else BoxKind.SILHOUETTE
        names = {name for name in listed if isinstance(name, str)}
        return [replace(each, box_kind=other if each.file_name in names else kind) for each in pictures]


def read_yolo(path: Path, on_fault: OnFault = raise_fault) -> list[PictureLabels]:
    """Returns all images of a dataset, each once, including those without a box.

    Args:
        path: `data.yaml`; its folder; or a folder of label files with `classes.txt` in it or above it.
    """
    if path.is_dir() and not (path / DATA_YAML).is_file():
        pictures = _with_classes(path, on_fault)
        _refuse_keypoints(path, pictures, is_said=False)
        return pictures
    file = _inside(path / DATA_YAML, path) if path.is_dir() else path
    data = _read_yaml(file)
    names = data.names if isinstance(data.names, dict) else dict(enumerate(data.names))
    _require_different(file, names)
    places = []
    for part in PARTS:
        value = getattr(data, part)
        places += [
            _part_path(file, part, data.path, each) for each in ([value] if isinstance(value, str) else value or [])
        ]
    found = _pictures(places, file.parent, names, on_fault)
    if not found:
        raise FormatError(file, "names no image: train, val and test are empty")
    _refuse_keypoints(file, found, is_said=data.kpt_shape is not None)
    return data.with_kinds(found)


def _refuse_keypoints(path: Path, pictures: Iterable[PictureLabels], *, is_said: bool) -> None:
    boxes = (box for each in pictures for box in each.boxes)
    around = [box for box in boxes if isinstance(box, YoloBox) and box.is_around]
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
    root, problem = file.parent, ""
    name = posix_path(entry)
    # some services export ../train/images where train/images is right
    for candidate in (str(PurePosixPath(posix_path(base or "")) / name), entry, name.removeprefix("../")):
        try:
            place = inside(root, candidate)
        except OutsideError as error:
            problem = problem or str(error)
            continue
        if place.exists() or _inside(_labels_of(place, root), root).is_dir():
            return place
        problem = f"there is no {entry[:NAME_SHOWN]!r} in the dataset's folder"
    raise FormatError(file, f"{part}: {problem}")


def _inside(path: Path, root: Path) -> Path:
    """Returns the path unchanged; raises FormatError if it is, or is behind, a link that leads out of the folder."""
    if not is_within(root, path):
        raise FormatError(path, "is a link that leads out of the dataset's folder; copy the file itself there")
    return path


def _labels_of(path: Path, root: Path) -> Path:
    """Returns the label path of an image, or the label folder of an image folder."""
    parts = list(path.resolve().relative_to(root.resolve()).parts)
    if "images" in parts:
        parts[len(parts) - 1 - parts[::-1].index("images")] = "labels"
    return root.resolve().joinpath(*parts)


def _pictures(
    places: Sequence[Path], root: Path, names: Mapping[int, str], on_fault: OnFault, *, all_labelled: bool = False
) -> list[PictureLabels]:
    """Returns the images in folders and lists, and the label files in folders that have no image.

    Args:
        all_labelled: an image without a label file is none of the dataset.
    """
    found: dict[Path, PictureLabels] = {}
    folders = [place for place in places if not place.is_file()]
    for place in places:
        pictures = _listed(place, root) if place.is_file() else _images_in(place, root)
        for picture in pictures:
            path = _labels_of(picture, root)
            if all_labelled and not spelled(path.parent, f"{path.stem}.txt").is_file():
                path = picture  # beside it, in a folder that is called `images`, too
            # in the Unicode form in which its name exists
            label_file = _inside(spelled(path.parent, f"{path.stem}.txt"), root)
            if label_file in found or (all_labelled and not label_file.is_file()):
                continue
            if picture.is_file() and picture.suffix.lower() in OTHERS:
                problem = "only PNG and JPEG images are supported; save it as PNG or JPEG under the same name"
                on_fault(FormatError(picture, problem))
            boxes = _boxes(label_file, names, on_fault) if label_file.is_file() else ()
            found[label_file] = _labels(picture.name, picture.parent, boxes)
    for place in folders:
        labels = _inside(_labels_of(place, root), root)
        for label_file in sorted(labels.rglob("*.txt")) if labels.is_dir() else []:
            if label_file not in found and label_file.name != CLASSES:
                boxes = _boxes(_inside(label_file, root), names, on_fault)
                found[label_file] = _labels(label_file.name, place, boxes)
    return list(found.values())


def _images_in(folder: Path, root: Path) -> Iterator[Path]:
    every = sorted(each for each in folder.rglob("*") if each.suffix.lower() in SUFFIXES)
    return (_inside(each, root) for each in every)


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


def _labels(file_name: str, folder: Path, boxes: tuple[YoloBox, ...]) -> PictureLabels:
    return PictureLabels(file_name, boxes, folder=folder, around=sum(box.is_around for box in boxes))


def _boxes(label_file: Path, names: Mapping[int, str], on_fault: OnFault) -> tuple[YoloBox, ...]:
    with reported(on_fault):
        return parse_boxes(label_file, read_text(label_file), names, on_fault)
    return ()


def _with_classes(folder: Path, on_fault: OnFault) -> list[PictureLabels]:
    """Returns the images of a folder of label files with `classes.txt`, one class name per line."""
    # the given folder itself may be a link; links inside it are checked
    folder = folder.resolve()
    file = next((each / CLASSES for each in (folder, folder.parent) if (each / CLASSES).is_file()), None)
    if file is None:
        raise FormatError(folder, f"is not a YOLO dataset: it has no {DATA_YAML}, and no {CLASSES} beside label files")
    _inside(file, file.parent)
    names = {number: name.strip() for number, name in enumerate(read_text(file).rstrip().splitlines())}
    _require_different(file, names)
    labels = folder / "labels" if (folder / "labels").is_dir() else folder
    # images are beside the labels, or in `images` beside `labels`
    is_apart = labels.name == "labels"
    places = [labels, *([labels.with_name("images")] if is_apart else [])]
    found = _pictures(places, labels.parent if is_apart else labels, names, on_fault, all_labelled=True)
    if not found:
        raise FormatError(labels, "has no label file (*.txt)")
    return found
