"""YOLO: the pixel convention, datasets on disk, errors of invalid lines, and links that must not be followed."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from annotator.formats.frame_names import PictureLabels, YoloBox
from annotator.formats.yolo import YoloWriter, dump_boxes, parse_boxes, read_yolo
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ConfigError, FormatError

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
def test_turned_boxes_and_polygons_are_the_rectangles_around_them(row: str, shares: tuple[float, ...]) -> None:
    (box, plain) = parse_boxes(FILE, f"{row}\n1 0.5 0.5 0.2 0.2 0.9\n", NAMES)
    assert box.shares == pytest.approx(shares)
    assert (box.score, box.is_around, plain.score, plain.is_around) == (1.0, True, 0.9, False)


BOX = Box2D("no", 0.5, 0.5, 2.5, 1.5)
ROW = "1 0.5000000 0.5000000 0.5000000 0.5000000\n"


def put(folder: Path, **files: str) -> Path:
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
    found = read_yolo(put(tmp_path, **files))
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
        read_yolo(put(tmp_path, **files))


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
    put(tmp_path, **here, **{"outside/x.png": "", "outside/y.txt": ROW, "outside/data.yaml": yaml_text})
    put(tmp_path, **{"outside/classes.txt": "b\n"})
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
        read_yolo(put(tmp_path, **{"labels/a.txt": row, "images/a.png": "", "data.yaml": yaml}))


def polygon(cx: float, cy: float, w: float, h: float, turn: float, corners: int) -> str:
    angles = np.arange(corners) * 2 * np.pi / corners + turn
    return "0 " + " ".join(f"{cx + w / 2 * np.cos(a):.6f} {cy + h / 2 * np.sin(a):.6f}" for a in angles)


def test_labels_may_be_beside_their_images_in_a_folder_that_is_called_images(tmp_path: Path) -> None:
    put(tmp_path, **{"classes.txt": "a\n", "images/a.txt": "0 0.5 0.5 0.2 0.2\n"})
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
    put(tmp_path, **{"classes.txt": "a\n"})
    put(tmp_path, **{f"labels/{number}.txt": f"{row}\n" for number, row in enumerate(rows)})
    if are_keypoints:
        with pytest.raises(FormatError, match=r"has keypoints \(.*keep the first five fields"):
            read_yolo(tmp_path)
    else:
        found = [box for picture in read_yolo(tmp_path) for box in picture.boxes]
        want = [np.array(row.split()[1:], float).reshape(-1, 2) for row in rows]
        edges = [[*(each.min(0) + each.max(0)) / 2, *np.ptp(each, axis=0)] for each in want]
        np.testing.assert_allclose([box.shares for box in found], edges)
