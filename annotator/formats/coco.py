"""COCO detection files: 2D boxes on images.

A COCO `bbox` is [x, y, width, height] in edge coordinates: an image covers [0, width] x [0, height]. In annotator the
centre of the first pixel is (0, 0), so 0.5 is subtracted. Source: the COCO data format page ("object detection") and
`coco.py` of its API. `attributes` of an annotation are an object of values by name, as CVAT writes them; `box_kind` and
`attributes` of an image are annotator's own.

A dataset is a folder with one image folder and one annotation file for each part, in COCO's own layout
(`annotations/instances_train2017.json`, `train2017/000000000009.jpg`). Without parts it has the single part `all`.

    annotations/instances_PART.json
    PART/FILE
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Hashable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from annotator.formats.dataset_writing import PictureWriter
from annotator.formats.frame_names import NO_VALUES, PictureLabels, Values, from_dotted
from annotator.formats.reading import OnFault, known_kind, raise_fault, read_model, reported, write_text
from annotator.types import Box2D
from annotator.types.bases import FileRecord
from annotator.types.errors import FormatError
from annotator.types.messages import amount

EDGE_TO_CENTRE_PX = -0.5
# CVAT's attribute of turned boxes: degrees about the centre of `bbox`, which is the box before the turn.
ROTATION = "rotation"
# Right boxes, and corners in place of them, reach beyond the image by at most this share of its side, but for a few.
WELL_BEYOND, MANY = 0.1, 0.25
# Share of a file's boxes that are valid corners if all were written as such.
NEARLY_ALL = 0.95
# Rounding of areas; some tools count the pixels of both edges.
AREA_OFF = 0.01


# Limit for pixel values; sums of such numbers stay finite.
LARGEST = 1e9
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST, allow_inf_nan=False)]
Side = Annotated[int, Field(gt=0, le=LARGEST)]


_POLYGONS: TypeAdapter[list[list[Number]]] = TypeAdapter(list[list[Number]])


class _Category(FileRecord):
    id: int
    name: str = Field(min_length=1)


class _Image(FileRecord):
    id: int
    file_name: str = Field(min_length=1)
    width: Side
    height: Side
    box_kind: object = None
    attributes: object = None


class _Annotation(FileRecord):
    id: int
    image_id: int
    category_id: int
    # some tools write an empty list for none
    bbox: Annotated[tuple[Number, Number, Number, Number] | None, BeforeValidator(lambda value: value or None)] = None
    # polygons x1 y1 x2 y2 ...; or a mask, which is ignored
    segmentation: object = None
    area: object = None
    iscrowd: int = 0
    score: float = Field(1.0, ge=0, le=1)
    attributes: object = None


class _File(FileRecord):
    images: tuple[_Image, ...]
    annotations: tuple[_Annotation, ...]
    categories: tuple[_Category, ...]


def read_coco(path: Path, on_fault: OnFault = raise_fault) -> list[PictureLabels]:
    """Returns all images of a COCO detection file in file order, including those without a box.

    A box that extends beyond its image is clipped to it. A turned box is read as the rectangle around it, and an
    annotation of polygons without a box as the rectangle around these.
    """
    file = read_model(path, _File)
    _require_unique(path, "category id", (category.id for category in file.categories))
    _require_unique(path, "category name", (category.name for category in file.categories))
    _require_unique(path, "image id", (image.id for image in file.images))
    _require_unique(path, "file_name", (image.file_name for image in file.images))
    _require_unique(path, "annotation id", (annotation.id for annotation in file.annotations))
    _require_unique(
        path,
        "box (image_id, category_id, bbox)",
        ((a.image_id, a.category_id, a.bbox, _turn_deg(a) or 0.0) for a in file.annotations if a.bbox is not None),
    )

    images = {image.id: image for image in file.images}
    names = {category.id: category.name for category in file.categories}
    _refuse_corners(path, file.annotations, images)
    boxes: dict[int, list[_Found]] = {image.id: [] for image in file.images}
    for annotation in file.annotations:
        with reported(on_fault):
            found = _found(path, annotation, images, names)
            boxes[annotation.image_id].append(found)
    return [_image(image, boxes[image.id]) for image in file.images]


def _refuse_corners(path: Path, annotations: Iterable[_Annotation], images: Mapping[int, _Image]) -> None:
    """Refuses boxes that are x1 y1 x2 y2.

    As corners, nearly all must be valid, as those of large objects in the upper left are, too. Then the areas decide.
    If these fit both readings, or neither, many boxes must reach well beyond their images if read as sizes.
    """
    found = [each for each in annotations if each.bbox is not None and not each.iscrowd and each.image_id in images]
    if not found:
        return
    boxes = np.array([each.bbox for each in found], np.float64)
    shown = np.array([(images[each.image_id].width, images[each.image_id].height) for each in found], np.float64)
    low, last = boxes[:, :2], boxes[:, 2:]
    most = (1 + WELL_BEYOND) * shown
    are_corners = ((last > low) & (last <= most) & (low >= -WELL_BEYOND * shown)).all(axis=1)
    if are_corners.mean() < NEARLY_ALL:
        return
    beyond = (low + last > most).any(axis=1)
    areas = np.array([_area_px(each) for each in found])
    as_sizes, as_corners = _have_area(last, areas), _have_area(last - low, areas)
    of_sizes, of_corners = (as_sizes & ~as_corners).mean(), (as_corners & ~as_sizes).mean()
    if of_sizes > 0.5 or (of_corners <= 0.5 and beyond.mean() < MANY):
        return
    shows = (
        f"as such, {amount(int(as_corners.sum()), 'box fits its area', 'boxes fit their areas')}"
        if of_corners > 0.5
        else f"as these, {amount(int(beyond.sum()), 'box reaches', 'boxes reach')} far beyond the image"
    )
    raise FormatError(
        path,
        f"bbox is x1 y1 x2 y2 in {are_corners.sum()} of {amount(len(found), 'box')}, and COCO has x y width height: "
        f"{shows}; write the width x2 - x1 and the height y2 - y1",
    )


def _area_px(annotation: _Annotation) -> float:
    """Returns the area that the box must have, as something else than the box says it; NaN if nothing does.

    It is that of the rectangle around the polygons; without a segmentation, it is `area`.
    """
    corners = np.array([value for polygon in _polygons(annotation.segmentation) for value in polygon]).reshape(-1, 2)
    if len(corners):
        return float(np.prod(np.ptp(corners, axis=0)))
    if annotation.segmentation or not isinstance(annotation.area, int | float):
        return math.nan
    return float(max(0, min(annotation.area, LARGEST**2)))


def _have_area(sizes: Float64[np.ndarray, "n 2"], areas: Float64[np.ndarray, "n"]) -> Bool[np.ndarray, "n"]:
    least, most = sizes.prod(axis=1) * (1 - AREA_OFF), (sizes + 1).prod(axis=1) * (1 + AREA_OFF)
    return (areas >= least) & (areas <= most)


class _Found(NamedTuple):
    """The box of an annotation, its attributes, and whether it is the rectangle around a turned box or polygons."""

    box: Box2D
    values: Values
    is_around: bool


def _image(image: _Image, found: Sequence[_Found]) -> PictureLabels:
    values = tuple(each.values for each in found) if any(each.values for each in found) else ()
    boxes, around = tuple(each.box for each in found), sum(each.is_around for each in found)
    kind, attributes = known_kind(image.box_kind), _values(image.attributes)
    size = (image.width, image.height)
    return PictureLabels(image.file_name, boxes, size, Path(), kind, values, attributes, around)


def _values(content: object) -> Values:
    """Returns the values by name; other tools also write lists of names, and values of other kinds, read as JSON."""
    if isinstance(content, list):
        return from_dotted(map(str, content))
    named = content.items() if isinstance(content, dict) else ()
    scalars = (bool, int, float, str)
    return {
        str(name): value if isinstance(value, scalars) else json.dumps(value)
        for name, value in named
        if value is not None
    }


def _require_unique(path: Path, what: str, values: Iterable[Hashable]) -> None:
    seen = set()
    for value in values:
        if value in seen:
            raise FormatError(path, f"{what} {value!r} is used twice; each must be unique")
        seen.add(value)


def _found(path: Path, annotation: _Annotation, images: Mapping[int, _Image], names: Mapping[int, str]) -> _Found:
    """Returns the annotation's box, clipped to its image."""
    where = f"annotation {annotation.id}"
    image = images.get(annotation.image_id)
    if image is None:
        raise FormatError(path, f"{where}: image_id {annotation.image_id} is not in images")
    if annotation.category_id not in names:
        raise FormatError(path, f"{where}: category_id {annotation.category_id} is not in categories")
    if annotation.iscrowd:
        raise FormatError(
            path, f"{where}: is a crowd region (iscrowd), not a single object; remove it or draw a box for each object"
        )
    # in annotator's own files, `rotation` is any attribute that somebody has called so
    turn_deg = None if known_kind(image.box_kind) is not None else _turn_deg(annotation)
    edges = _rectangle(path, where, annotation, turn_deg or 0.0)
    x, y, width, height = edges
    if width <= 0 or height <= 0:
        raise FormatError(path, f"{where}: bbox {list(edges)} must have a positive width and height")
    left, right = (edge + EDGE_TO_CENTRE_PX for edge in (max(x, 0.0), min(x + width, image.width)))
    top, bottom = (edge + EDGE_TO_CENTRE_PX for edge in (max(y, 0.0), min(y + height, image.height)))
    if right <= left or bottom <= top:
        raise FormatError(
            path,
            f"{where}: bbox {list(edges)} lies outside {image.file_name!r}, which is {image.width} x {image.height} px",
        )
    values = _values(annotation.attributes)
    if turn_deg is not None:
        values = {name: value for name, value in values.items() if name != ROTATION}
    box = Box2D(names[annotation.category_id], left, top, right, bottom, annotation.score)
    return _Found(box, values, edges != annotation.bbox)


def _turn_deg(annotation: _Annotation) -> float | None:
    """Returns by how many degrees the box is turned about its centre, as CVAT writes it; None if nothing says it."""
    attributes = annotation.attributes
    value = attributes.get(ROTATION) if isinstance(attributes, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    with suppress(ValueError, OverflowError):
        turn_deg = float(value)
        return turn_deg if math.isfinite(turn_deg) else None
    return None


def _rectangle(path: Path, where: str, annotation: _Annotation, turn_deg: float) -> tuple[float, float, float, float]:
    """Returns x, y, width, height of a box, of the rectangle around a turned one, or around polygons without a box."""
    if annotation.bbox is None:
        corners = [float(value) for polygon in _polygons(annotation.segmentation) for value in polygon]
        if not corners:
            raise FormatError(path, f"{where}: has no bbox, and no polygons as segmentation; add its bbox")
        left, top = min(corners[::2]), min(corners[1::2])
        return left, top, max(corners[::2]) - left, max(corners[1::2]) - top
    x, y, width, height = annotation.bbox
    if turn_deg % 180 == 0 or width <= 0 or height <= 0:
        return annotation.bbox
    cosine, sine = abs(math.cos(math.radians(turn_deg))), abs(math.sin(math.radians(turn_deg)))
    wide, high = width * cosine + height * sine, width * sine + height * cosine
    return x + (width - wide) / 2, y + (height - high) / 2, wide, high


def _polygons(segmentation: object) -> list[list[float]]:
    """Returns the polygons of a segmentation; none if it is a mask, or not as COCO has it."""
    try:
        polygons = _POLYGONS.validate_python(segmentation)
    except ValidationError:
        return []
    return polygons if all(len(polygon) % 2 == 0 for polygon in polygons) else []


def write_coco(path: Path, images: Sequence[PictureLabels], classes: Sequence[str] = ()) -> None:
    """Writes a COCO detection file atomically; ids count from 1.

    Args:
        path: the file; its folder must exist.
        images: the images with their boxes.
        classes: categories to list first, in this order, with or without boxes; others follow by name.
    """
    _require_unique(path, "file_name", (image.file_name for image in images))
    others = {box.label for image in images for box in image.boxes} - set(classes)
    ids = {name: number for number, name in enumerate([*dict.fromkeys(classes), *sorted(others)], 1)}
    every = [
        (image_id, box, values)
        for image_id, image in enumerate(images, 1)
        for box, values in zip(_pixels(image), image.values or repeat(NO_VALUES), strict=False)
    ]
    content = {
        "images": [
            {"id": image_id, "file_name": image.file_name}
            | dict(zip(("width", "height"), image.size_px or (), strict=True))
            | ({} if image.box_kind is None else {"box_kind": image.box_kind.value})
            | ({"attributes": dict(image.attributes)} if image.attributes else {})
            for image_id, image in enumerate(images, 1)
        ],
        "annotations": [_annotation(number, *each, ids) for number, each in enumerate(every, 1)],
        "categories": [{"id": number, "name": name, "supercategory": ""} for name, number in ids.items()],
    }
    write_text(path, json.dumps(content, indent=1) + "\n")


def _pixels(image: PictureLabels) -> tuple[Box2D, ...]:
    assert image.size_px is not None  # COCO's boxes are in pixels
    return image.boxes_on(*image.size_px)


def _annotation(number: int, image_id: int, box: Box2D, values: Values, ids: Mapping[str, int]) -> dict[str, object]:
    entry: dict[str, object] = {
        "id": number,
        "image_id": image_id,
        "category_id": ids[box.label],
        "bbox": [box.x_min - EDGE_TO_CENTRE_PX, box.y_min - EDGE_TO_CENTRE_PX, box.width_px, box.height_px],
        "area": box.width_px * box.height_px,
        "iscrowd": 0,
    }
    if box.score != 1.0:
        entry["score"] = box.score
    if values:
        entry["attributes"] = dict(values)
    return entry


ANNOTATIONS = "annotations"
WHOLE = "all"
_FILE = re.compile(r"instances_(.+)\.json")


class CocoWriter(PictureWriter):
    """The ids of the categories count from 1 in the order of the classes."""

    def __init__(self, folder: Path, classes: Sequence[str], parts: Sequence[str] = ()) -> None:
        super().__init__(folder, classes, parts or (WHOLE,))
        if ANNOTATIONS in parts:
            raise FormatError(
                folder,
                f"a part cannot be called {ANNOTATIONS}: COCO stores the boxes in a folder of this name",
            )
        self._images: dict[str, list[PictureLabels]] = {part: [] for part in self.parts}
        for part in self.parts:
            (folder / part).mkdir()

    def add(self, picture: PictureLabels, content: bytes, part: str | None = None) -> None:
        self.put(f"{part or WHOLE}/{picture.file_name}", content)
        self._images[part or WHOLE].append(picture)

    def finish(self) -> Mapping[str, Path]:
        (self.folder / ANNOTATIONS).mkdir()
        for part, images in self._images.items():
            write_coco(self.folder / ANNOTATIONS / f"instances_{part}.json", images, self.classes)
        return {part: self.folder / part for part in self.parts}


def coco_files(path: Path) -> list[tuple[Path, Path]]:
    """Returns each annotation file with the folder of its images.

    Args:
        path: the folder of a dataset, or one annotation file. Images of a file in `annotations` are in the folder
            named after its part; images of any other file are beside it.
    """
    if path.is_dir():
        files = sorted(file for file in (path / ANNOTATIONS).glob("*.json") if _FILE.fullmatch(file.name))
        if not files:
            raise FormatError(path, f"has no {ANNOTATIONS}/instances_*.json; pass the path of the COCO file instead")
    else:
        files = [path]
    return [(file, _pictures(file)) for file in files]


def _pictures(file: Path) -> Path:
    match = _FILE.fullmatch(file.name)
    if match is None or file.parent.name != ANNOTATIONS:
        return file.parent
    folder = file.parent.parent / match[1]
    return folder if folder.is_dir() else file.parent.parent


def dataset_folder(path: Path) -> Path:
    """Returns the dataset folder of a path that `coco_files` accepts."""
    if path.is_dir():
        return path
    return path.parent.parent if path.parent.name == ANNOTATIONS else path.parent


def read_coco_dataset(path: Path, on_fault: OnFault = raise_fault) -> list[PictureLabels]:
    """Returns the images of all annotation files."""
    return [
        replace(image, folder=pictures) for file, pictures in coco_files(path) for image in read_coco(file, on_fault)
    ]
