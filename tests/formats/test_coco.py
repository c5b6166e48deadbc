"""COCO detection files: the pixel convention, round trips, and errors of invalid files."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels
from annotator.types import Box2D
from annotator.types.errors import FormatError

GOOD: dict[str, Any] = {
    "info": {"description": "another tool's field"},
    "images": [
        {"id": 7, "file_name": "a.png", "width": 10, "height": 8, "license": 1},
        {"id": 9, "file_name": "sub/b.png", "width": 20, "height": 20},
    ],
    "annotations": [
        {"id": 3, "image_id": 7, "category_id": 5, "bbox": [0, 0, 10, 8], "segmentation": [], "area": 80, "iscrowd": 0},
        {"id": 4, "image_id": 7, "category_id": 2, "bbox": [2.5, 3, 4, 2]},
    ],
    "categories": [{"id": 5, "name": "hand"}, {"id": 2, "name": "person", "supercategory": "animal"}],
}


def put(folder: Path, content: Any) -> Path:
    path = folder / "boxes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_coordinates_are_shifted_by_half_a_pixel(tmp_path: Path) -> None:
    first, second = read_coco(put(tmp_path, GOOD))
    assert (first.file_name, first.size_px) == ("a.png", (10, 8))
    # a box around the whole image covers [-0.5, width - 0.5], as in Camera
    assert first.boxes[0] == Box2D("hand", -0.5, -0.5, 9.5, 7.5)
    assert first.boxes[1] == Box2D("person", 2.0, 2.5, 6.0, 4.5)
    assert (second.file_name, second.boxes) == ("sub/b.png", ())
    clipped = read_coco(put(tmp_path, broken("annotations.0.bbox", [-3, 2, 100, 2])))[0].boxes[0]
    assert clipped.xyxy == (-0.5, 1.5, 9.5, 3.5)


def broken(place: str, value: Any) -> dict[str, Any]:
    """GOOD with the value at a dotted place replaced."""
    content = copy.deepcopy(GOOD)
    target: Any = content
    *parents, last = [int(part) if part.isdigit() else part for part in place.split(".")]
    for part in parents:
        target = target[part]
    target[last] = value
    return content


def repeated(part: str, **changes: Any) -> dict[str, Any]:
    content = copy.deepcopy(GOOD)
    content[part].append({**content[part][0], **changes})
    return content


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (broken("annotations.1.image_id", 8), "annotation 4: image_id 8 is not in images"),
        (broken("annotations.1.category_id", 8), "annotation 4: category_id 8 is not in categories"),
        (broken("annotations.1.bbox", [1, 2, -3, 4]), "must have a positive width and height"),
        (broken("annotations.1.bbox", [10, 2, 3, 4]), "lies outside 'a.png', which is 10 x 8 px"),
        (broken("annotations.1.iscrowd", 1), "crowd region"),
        (repeated("annotations", id=1), "box (image_id, category_id, bbox) (7, 5"),
        (repeated("categories", id=1), "category name 'hand' is used twice"),
    ],
)
def test_errors_name_the_file_and_the_place(tmp_path: Path, content: Any, says: str) -> None:
    path = put(tmp_path, content)
    with pytest.raises(FormatError) as caught:
        read_coco(path)
    assert str(path) in str(caught.value)
    assert says in str(caught.value)


def test_categories_are_in_the_given_order_then_by_name(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    boxes = tuple(Box2D(label, 0.0, 0.0, 1.0, 1.0) for label in ("zebra", "hand", "ant"))
    write_coco(path, [PictureLabels("a.png", boxes, (10, 8))], classes=["person", "hand"])
    content = json.loads(path.read_text())
    assert [(c["id"], c["name"]) for c in content["categories"]] == [
        (1, "person"), (2, "hand"), (3, "ant"), (4, "zebra"),
    ]  # fmt: skip
    assert content["annotations"][0]["bbox"] == [0.5, 0.5, 1.0, 1.0]
    assert [a["id"] for a in content["annotations"]] == [1, 2, 3]


def turned(rotation: object, bbox: object = (2, 2, 4, 2), **fields: Any) -> Any:
    content = copy.deepcopy(GOOD)
    content["images"][0] |= {"width": 100, "height": 80} | fields.pop("image", {})
    annotation = {"id": 1, "image_id": 7, "category_id": 5, "attributes": {"occluded": False, "rotation": rotation}}
    content["annotations"] = [annotation | ({} if bbox is None else {"bbox": bbox}) | fields]
    return content


POLYGONS = [[30, 20, 50, 20, 40, 45], [38, 44, 42, 44, 40, 60]]


@pytest.mark.parametrize(
    ("content", "edges", "around"),
    [
        # edges from the picture's corner
        (turned(90, (20, 30, 40, 10)), (35, 15, 45, 55), 1),
        (turned(45.0, (20, 30, 30, 10)), (35 - 200**0.5, 35 - 200**0.5, 35 + 200**0.5, 35 + 200**0.5), 1),
        (turned("90", (20, 30, 40, 10)), (35, 15, 45, 55), 1),
        # no angle, but somebody's own attribute
        (turned("left", (20, 30, 40, 10)), (20, 30, 60, 40), 0),
        (turned(0, (-5, 30, 40, 10)), (0, 30, 35, 40), 0),
        # the rectangle around a turned box may reach beyond the picture
        (turned(90, (0, 0, 40, 10)), (15, 0, 25, 25), 1),
        # polygons without a box, and with one
        (turned(0, None, segmentation=POLYGONS), (30, 20, 50, 60), 1),
        # somebody's own attribute in a file of annotator
        (turned(45, (20, 30, 40, 10), image={"box_kind": "box"}), (20, 30, 60, 40), 0),
    ],
)
def test_turned_boxes_and_polygons_are_the_rectangles_around_them(
    tmp_path: Path, content: Any, edges: tuple[float, ...], around: int
) -> None:
    image = read_coco(put(tmp_path, content))[0]
    assert image.boxes[0].xyxy == pytest.approx(np.array(edges) - 0.5, abs=1e-4)
    assert image.around == around
    rotation = content["annotations"][0]["attributes"]["rotation"]
    kept = {"rotation": rotation} if rotation == "left" or image.box_kind is not None else {}
    assert image.values == ({"occluded": False} | kept,)


@pytest.mark.parametrize("segmentation", [None, [[1, 2, 3], [4, 5, 6]], {"counts": "abc", "size": [8, 10]}])
def test_an_annotation_without_box_and_polygons_is_an_error(tmp_path: Path, segmentation: object) -> None:
    with pytest.raises(FormatError, match="annotation 1: has no bbox, and no polygons as segmentation"):
        read_coco(put(tmp_path, turned(0, None, segmentation=segmentation)))


SHOWN = (640, 480)
# upper left and lower right corners, well spread over the image
CORNERS = np.array(
    [[30, 40, 130, 90], [300, 200, 420, 330], [500, 350, 640, 481], [20, 300, 200, 420], [330, 20, 630, 300]], float
)
SIZES = np.c_[CORNERS[:, :2], CORNERS[:, 2:] - CORNERS[:, :2]]
# as of one large object in each image: both readings are in the image
LARGE = np.array([[20, 30, 500, 400], [100, 80, 420, 390], [0, 0, 640, 480], [50, 20, 590, 460]], float)
# those of small objects in the upper left, which do not reach beyond the image as sizes
NEAR = np.array([[10, 20, 100, 90], [50, 40, 200, 150], [110, 100, 240, 210]], float)


def areas(rows: np.ndarray, *, as_corners: bool = False) -> list[float]:
    return (rows[:, 2:] - (rows[:, :2] if as_corners else 0)).prod(axis=1).tolist()


@pytest.mark.parametrize(
    ("rows", "area", "are_corners"),
    [
        pytest.param(CORNERS, None, True, id="corners"),
        pytest.param(CORNERS, areas(CORNERS, as_corners=True), True, id="areas-of-corners"),
        pytest.param(NEAR, areas(NEAR, as_corners=True), True, id="only-the-areas-show-it"),
        pytest.param(SIZES, None, False, id="sizes"),
        pytest.param(LARGE + np.array([5, 5, 40, 30]), None, False, id="slightly-outside"),
        pytest.param(NEAR, areas(NEAR), False, id="near"),
    ],
)
@pytest.mark.parametrize("said", ["area", "polygon"])
def test_corners_in_place_of_sizes_are_refused(
    tmp_path: Path, rows: np.ndarray, area: list[float] | None, are_corners: bool, said: str
) -> None:
    annotations = [
        {"id": number, "image_id": 1, "category_id": 1, "bbox": row, "segmentation": []}
        for number, row in enumerate(rows.tolist())
    ]
    for entry, px in zip(annotations, area or (), strict=False):
        # a lozenge in a rectangle of this area
        lozenge = {"segmentation": [[50, 0, 100, px / 200, 50, px / 100, 0, px / 200]], "area": px / 2}
        entry |= lozenge if said == "polygon" else {"area": px}
    images = [{"id": 1, "file_name": "a.png", "width": SHOWN[0], "height": SHOWN[1]}]
    path = put(tmp_path, {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "a"}]})
    if are_corners:
        with pytest.raises(
            FormatError, match=r"bbox is x1 y1 x2 y2 in \d+ of \d+ box(es)?, and COCO has x y width height"
        ):
            read_coco(path)
    else:
        (image,) = read_coco(path)
        low, size = rows[:, :2], rows[:, 2:]
        want = np.c_[low, np.minimum(low + size, SHOWN)] - 0.5
        np.testing.assert_allclose(np.array([box.xyxy for box in image.boxes]).reshape(-1, 4), want)
