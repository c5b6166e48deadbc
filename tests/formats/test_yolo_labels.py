"""YOLO label files: the pixel convention, round trips, and errors of invalid lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.formats.yolo import YoloBox, dump_boxes, parse_boxes
from annotator.types import Box2D
from annotator.types.errors import FormatError

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
        ("0 0.1 0.1 0.2 0.1 0.2 0.2 0.3", "has 8 fields.*polygon.*keypoints are not supported"),
        ("person 0.5 0.5 1 1", "must hold numbers .*; 'person' is not the number of a class"),
        ("0.0 0.5 0.5 1 1", "must hold numbers"),
        ("0 0,5 0.5 1 1", "must hold numbers .*: '0,5' has a decimal comma; write a point"),
        ("0 1_0 0.5 1 1", "must hold numbers"),
        ("2 0.5 0.5 1 1", "class 2 has no name; classes with a name go from 0 to 1"),
        ("-1 0.5 0.5 1 1", "class -1 has no name"),
        ("0 nan 0.5 1 1", "finite"),
        ("0 0.5 0.5 inf 1", "finite"),
        ("0 0.5 0.5 0 1", "non-empty box"),
        ("0 0.5 0.5 0.1 -0.1", "non-empty box"),
        ("0 320 240 100 100", "fractions of the image"),
        ("0 1.005 0.5 0.01 0.1", "the box is outside the image"),
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
