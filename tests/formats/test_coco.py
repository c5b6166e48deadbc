"""2D formats, COCO and YOLO: the pixel convention, round trips, data sets on disk, invalid files and links."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from annotator.formats.coco import read_coco, write_coco
from annotator.formats.frame_names import PictureLabels, YoloBox
from annotator.formats.yolo import YoloWriter, dump_boxes, parse_boxes, read_yolo
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ConfigError, FormatError

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


NAMES = {0: "person", 1: "hand"}
NUMBERS = {"person": 0, "hand": 1}
FILE = Path("labels/a.txt")


def test_fractions_are_measured_from_the_corner() -> None:
    """Computed by hand for an image of 8 x 4 pixels, whose corner is at (-0.5, -0.5)."""
    whole = Box2D("person", -0.5, -0.5, 7.5, 3.5)
    second_pixel = Box2D("hand", 0.5, -0.5, 1.5, 0.5)
    text = "0 0.5000000 0.5000000 1.0000000 1.0000000\n1 0.1875000 0.1250000 0.1250000 0.2500000\n"
    assert dump_boxes([whole, second_pixel], NUMBERS, 8, 4) == text
    assert [box.on(8, 4) for box in parse_boxes(FILE, text, NAMES)] == [whole, second_pixel]
    assert dump_boxes([], NUMBERS, 8, 4) == "" and parse_boxes(FILE, " \n\n", NAMES) == ()


def test_a_score_is_read_and_boxes_are_clipped_to_the_image() -> None:
    (box,) = parse_boxes(FILE, "0 0.95 0.5 0.11 0.5 0.25\n", NAMES)
    assert box == YoloBox("person", (0.95, 0.5, 0.11, 0.5), 0.25)
    cut = box.on(100, 100)
    assert (cut.label, cut.score, cut.xyxy) == ("person", 0.25, pytest.approx((89.0, 24.5, 99.5, 74.5)))


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("0 0.5 0.5 1", "has 4 fields"),
        ("person 0.5 0.5 1 1", "must hold numbers .*; 'person' is not the number of a class"),
        ("2 0.5 0.5 1 1", "class 2 has no name; classes with a name go from 0 to 1"),
        ("0 0.5 0.5 0 1", "non-empty box"),
        ("0 320 240 100 100", "fractions of the image"),
        ("0 0.5 0.5 1 1 1.5", "score must be in 0..1"),
        ("1 0.5 0.5 0.2 0.2", "the same box as in line 1"),
    ],
)
def test_errors_name_the_line(row: str, says: str) -> None:
    with pytest.raises(FormatError, match=rf"a\.txt:3: {says}|a\.txt:3: .*{says}"):
        parse_boxes(FILE, f"1 0.5 0.5 0.2 0.2\n\n{row}\n", NAMES)


@pytest.mark.parametrize(
    ("row", "shares"),
    [
        # a turned box by its corners, a triangle, and a polygon of five corners
        ("0 0.5 0.1 0.9 0.5 0.5 0.9 0.1 0.5", (0.5, 0.5, 0.8, 0.8)),
        ("1 0.2 0.3 0.6 0.3 0.4 0.7", (0.4, 0.5, 0.4, 0.4)),
        ("0 0.1 0.1 0.3 0.1 0.4 0.2 0.3 0.5 0.1 0.5", (0.25, 0.3, 0.3, 0.4)),
    ],
)
def test_turned_rows_and_polygons_of_yolo_are_the_rectangles_around_them(row: str, shares: tuple[float, ...]) -> None:
    (box, plain) = parse_boxes(FILE, f"{row}\n1 0.5 0.5 0.2 0.2 0.9\n", NAMES)
    assert box.shares == pytest.approx(shares)
    assert (box.score, box.is_around, plain.score, plain.is_around) == (1.0, True, 0.9, False)


BOX = Box2D("no", 0.5, 0.5, 2.5, 1.5)
ROW = "1 0.5000000 0.5000000 0.5000000 0.5000000\n"


def put_files(folder: Path, **files: str) -> Path:
    """A folder of files: `put(tmp_path, **{"labels/a.txt": "..."})`."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_a_written_dataset_reads_back(tmp_path: Path) -> None:
    writer = YoloWriter(tmp_path, ["Büro \U0001f600", "no"], ["val", "train"])
    writer.add(PictureLabels("a.b.png", (BOX,), (4, 2), box_kind=BoxKind.SILHOUETTE), b"png", "train")
    writer.add(PictureLabels("c.png", (), (4, 2), box_kind=BoxKind.SILHOUETTE), b"png", "val")
    folders = writer.finish()
    assert folders == {"train": tmp_path / "images/train", "val": tmp_path / "images/val"}
    assert (tmp_path / "labels/train/a.b.txt").read_text() == "1 0.5000000 0.7500000 0.5000000 0.5000000\n"
    assert (tmp_path / "labels/val/c.txt").read_text() == ""
    assert yaml.safe_load((tmp_path / "data.yaml").read_text()) == {
        "path": "",
        "train": "images/train",
        "val": "images/val",
        "names": {0: "Büro \U0001f600", 1: "no"},
        "box_kind": "silhouette",
    }
    first, second = read_yolo(tmp_path)
    assert first.file(tmp_path) == tmp_path / "images/train/a.b.png"
    assert first.boxes_on(4, 2) == (BOX,) and second.boxes == ()
    YoloWriter(tmp_path / "whole", ["no"]).finish()
    content = yaml.safe_load((tmp_path / "whole/data.yaml").read_text())
    assert (content["train"], content["val"]) == ("images/train", "images/train"), "validated on its training images"
    with pytest.raises(ConfigError, match=r"train, val and \(optionally\) test, not train, dev"):
        YoloWriter(tmp_path / "other", ["no"], ["train", "dev"])


@pytest.mark.parametrize(
    ("files", "pictures"),
    [
        # only labels came back from the annotation tool
        ({"data.yaml": "train: images/train\nnames: [a, b]", "labels/train/x.txt": ROW}, [("x.txt", 1)]),
        # an absolute path of another machine; `../train/images`, as some services write it
        ({"data.yaml": "path: /gone\ntrain: ../train/images\nnames: {0: a, 1: b}", "train/images/x.jpg": "",
          "train/labels/x.txt": ROW, "train/images/y.jpg": ""}, [("x.jpg", 1), ("y.jpg", 0)]),
        # a list of images, with the labels beside them
        ({"data.yaml": "train: [list.txt]\nnames: [a, b]", "list.txt": "./d/x.png\n\nd/y.png\n", "d/x.png": "",
          "d/x.txt": ROW, "d/y.png": ""}, [("x.png", 1), ("y.png", 0)]),
        # label files with classes.txt
        ({"classes.txt": "a\nb\n", "x.txt": ROW, "y.txt": ""}, [("x.txt", 1), ("y.txt", 0)]),
        ({"classes.txt": "a\nb\n", "labels/x.txt": ROW, "images/x.png": ""}, [("x.png", 1)]),
    ],
    ids=["labels alone", "moved", "list", "classes.txt", "classes.txt above"],
)  # fmt: skip
def test_datasets_of_other_tools_are_read(
    tmp_path: Path, files: dict[str, str], pictures: list[tuple[str, int]]
) -> None:
    found = read_yolo(put_files(tmp_path, **files))
    assert [(picture.file_name, len(picture.boxes)) for picture in found] == pictures
    assert {box.label for picture in found for box in picture.boxes} == {"b"}


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({"a.txt": ROW}, "no data.yaml, and no classes.txt"),
        ({"classes.txt": "a\na\n", "x.txt": ""}, "names must be unique"),
        # a value that does not match its tag
        ({"data.yaml": "names: [a]\ntrain: !!int x"}, "is not valid YAML"),
        ({"data.yaml": "names: [a, 1]\ntrain: x"}, "write class names and paths as text, in quotes"),
        ({"data.yaml": "train: 'D:\\\\set'\nnames: [a]"}, "is a path of another computer; write it rel"),
        ({"data.yaml": "train: images\nnames: [a]"}, "train: there is no 'images'"),
        ({"data.yaml": "path: ..\ntrain: ../../../etc\nnames: [a]"}, "leads out of the folder"),
        ({"data.yaml": "train: l.txt\nnames: [a]", "l.txt": "\n../../x.png"}, r"l\.txt:2: .* leads out"),
        ({"data.yaml": "train: i\nnames: [a]", "i/x.png": "", "i/x.txt": "0 1"}, r"i/x\.txt:1: has 2 fields"),
        (
            {"data.yaml": "train: i\nnames: [a]", "i/x.BMP": ""},
            r"i/x\.BMP: only PNG and JPEG images are supported; save",
        ),
    ],
)
def test_errors_name_the_place(tmp_path: Path, files: dict[str, str], says: str) -> None:
    with pytest.raises(FormatError, match=says):
        read_yolo(put_files(tmp_path, **files))


@pytest.mark.parametrize(
    ("link", "target"),
    [
        ("set/images/x.png", "outside/x.png"),
        ("set/labels", "outside"),
        ("set/data.yaml", "outside/data.yaml"),
        ("flat/classes.txt", "outside/classes.txt"),
        ("flat/images/y.png", "outside/x.png"),
    ],
)
def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path, link: str, target: str) -> None:
    yaml_text = "train: images\nnames: [a]"
    here = {"set/data.yaml": yaml_text, "set/images/y.png": "", "flat/classes.txt": "a\n", "flat/labels/y.txt": ""}
    put_files(tmp_path, **here, **{"outside/x.png": "", "outside/y.txt": ROW, "outside/data.yaml": yaml_text})
    put_files(tmp_path, **{"outside/classes.txt": "b\n"})
    dataset = tmp_path / Path(link).parts[0]
    assert len(read_yolo(dataset)) == 1
    place = tmp_path / link
    if place.is_dir():
        shutil.rmtree(place)
    place.unlink(missing_ok=True)
    place.parent.mkdir(exist_ok=True)
    place.symlink_to(tmp_path / target)
    with pytest.raises(FormatError, match=rf"/{place.name}.*: is a link that leads out"):
        read_yolo(dataset)


def test_other_tools_words_for_the_kind_of_boxes_are_ignored(tmp_path: Path) -> None:
    writer = YoloWriter(tmp_path, ("no",))
    kinds = [BoxKind.BOX, BoxKind.BOX, BoxKind.SILHOUETTE]
    for name, kind in zip("abc", kinds, strict=True):
        writer.add(PictureLabels(f"{name}.png", (BOX,), (4, 2), box_kind=kind), b"")
    writer.finish()
    text = (tmp_path / "data.yaml").read_text()
    for theirs, found in (("box_kind: tight", [None] * 3), ("box_kind: [1]", [None] * 3), ("box_kind: box", kinds)):
        (tmp_path / "data.yaml").write_text(text.replace("box_kind: box", theirs, 1))
        assert [picture.box_kind for picture in read_yolo(tmp_path)] == found


def test_keypoints_that_data_yaml_names_are_refused(tmp_path: Path) -> None:
    row = "0 0.5 0.1 0.9 0.5 0.5 0.9 0.1 0.5\n"
    yaml = "train: images\nnames: [person]\nkpt_shape: [2, 2]\n"
    with pytest.raises(FormatError, match="has keypoints"):
        read_yolo(put_files(tmp_path, **{"labels/a.txt": row, "images/a.png": "", "data.yaml": yaml}))


def polygon(cx: float, cy: float, w: float, h: float, turn: float, corners: int) -> str:
    angles = np.arange(corners) * 2 * np.pi / corners + turn
    return "0 " + " ".join(f"{cx + w / 2 * np.cos(a):.6f} {cy + h / 2 * np.sin(a):.6f}" for a in angles)


def test_labels_may_be_beside_their_images_in_a_folder_that_is_called_images(tmp_path: Path) -> None:
    put_files(tmp_path, **{"classes.txt": "a\n", "images/a.txt": "0 0.5 0.5 0.2 0.2\n"})
    (tmp_path / "images/a.png").touch()
    (picture,) = read_yolo(tmp_path)
    assert (picture.file_name, picture.folder.name, len(picture.boxes)) == ("a.png", "images", 1)


POINT = "0 0.5 0.5 0.1 0.1 0.48 0.47 0.52 0.53"


@pytest.mark.parametrize(
    ("rows", "are_keypoints"),
    [
        ([POINT], True),
        (["0 0.5 0.5 0.1 0.1 0.48 0.47 0 0"], True),  # one is missing
        (["0 0.5 0.5 0.1 0.1 0.48 0.47 2 0.52 0.53 1"], True),
        # boxes with four points each, in the middle and where sizes are as large as places
        ([f"0 0.5 0.5 0.1 0.05 {polygon(0.5, 0.5, 0.09, 0.045, 0.4, 4)[2:]}"] * 2, True),
        ([f"0 {x} 0.11 0.1 0.1 {polygon(x, 0.11, 0.09, 0.09, 0.4, 4)[2:]}" for x in (0.1, 0.12, 0.11)], True),
        # small polygons in the upper left hold their points, read as boxes
        *(([polygon(0.5, 0.5, w, 0.9 * w, 0.4, corners)], False) for w in (0.05, 0.5) for corners in (3, 4, 12)),
        # one polygon by chance, the other not
        ([POINT, polygon(0.4, 0.6, 0.1, 0.1, 0.4, 4)], False),
    ],
)
def test_rows_that_are_all_boxes_with_points_are_keypoints(
    tmp_path: Path, rows: list[str], are_keypoints: bool
) -> None:
    put_files(tmp_path, **{"classes.txt": "a\n"})
    put_files(tmp_path, **{f"labels/{number}.txt": f"{row}\n" for number, row in enumerate(rows)})
    if are_keypoints:
        with pytest.raises(FormatError, match=r"has keypoints \(.*keep the first five fields"):
            read_yolo(tmp_path)
    else:
        found = [box for picture in read_yolo(tmp_path) for box in picture.boxes]
        want = [np.array(row.split()[1:], float).reshape(-1, 2) for row in rows]
        edges = [[*(each.min(0) + each.max(0)) / 2, *np.ptp(each, axis=0)] for each in want]
        np.testing.assert_allclose([box.shares for box in found], edges)
