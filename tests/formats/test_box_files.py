"""CSV files of boxes and boxes.json, and the errors of invalid ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from annotator.formats.box_csv import BoxRow, read_box_csv
from annotator.formats.boxes_json import read_boxes, write_boxes
from annotator.geometry.oriented_box import box_corners
from annotator.types.errors import FormatError

HEAD = "image,class,cx,cy,cz,l,w,h,yaw,score"
ROW = "3,night_stand,-0.5,3.25,-0.75,1.5,2,1,-0.25,0.875"


def file_of(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "boxes.csv"
    path.write_text("\n".join(lines))
    return path


def test_rows_are_read(tmp_path: Path) -> None:
    expected = BoxRow("3", "night_stand", (-0.5, 3.25, -0.75), (1.5, 2.0, 1.0), -0.25, 0.875)
    assert read_box_csv(file_of(tmp_path, HEAD, ROW, "", ROW + "\r"), scored=True) == [expected, expected]
    without = read_box_csv(file_of(tmp_path, HEAD.removesuffix(",score"), ROW.removesuffix(",0.875")), scored=False)
    assert without[0].score is None
    assert read_box_csv(file_of(tmp_path, HEAD), scored=True) == []


BROKEN = [
    pytest.param([], 1, "image is missing", id="empty"),
    pytest.param([HEAD.removesuffix(",score"), ROW], 1, "has no column score", id="no-score"),
    pytest.param([HEAD + ",colour", ROW], 1, "'colour' is unknown", id="unknown-column"),
    pytest.param([HEAD + ",yaw", ROW], 1, "two columns have the same name", id="column-twice"),
    pytest.param([HEAD, ROW, "3,bed"], 3, "has 2 fields", id="too-few"),
    pytest.param([HEAD, ROW.replace("-0.75", "-0,75")], 2, "numbers need a decimal point", id="comma"),
    pytest.param([HEAD, ROW.replace("-0.25", "nan")], 2, "yaw: 'nan' is not a finite", id="nan"),
    pytest.param([HEAD, ROW.replace(",2,", ",-2,")], 2, "must be positive", id="negative-size"),
    pytest.param([HEAD, ROW.replace("night_stand", " ")], 2, "must not be empty", id="no-class"),
    pytest.param([HEAD, '3,"bed'], 2, "is not valid CSV", id="open-quote"),
]


@pytest.mark.parametrize(("lines", "line", "problem"), BROKEN)
def test_errors_name_the_file_and_line(tmp_path: Path, lines: list[str], line: int, problem: str) -> None:
    path = file_of(tmp_path, *lines)
    with pytest.raises(FormatError, match=problem) as caught:
        read_box_csv(path, scored=True)
    assert (caught.value.path, caught.value.line) == (path, line)


UNIT = {"label": "hand", "center": [0, 0, 1], "size": [0.2, 0.1, 0.05], "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}


def write(folder: Path, content: object) -> Path:
    path = folder / "boxes.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_frame_may_have_one_object_a_list_or_an_empty_list(tmp_path: Path):
    boxes = read_boxes(write(tmp_path, {"a": UNIT, "b": [UNIT, UNIT | {"track": 4, "note": "?"}], "c": []}))
    assert {key: len(truths) for key, truths in boxes.items()} == {"a": 1, "b": 2, "c": 0}
    (truth,) = boxes["a"]
    assert (truth.label, truth.track_id, boxes["b"][1].track_id) == ("hand", None, 4)
    # the columns of `rotation` are the axes: the box's x is the camera's y here
    np.testing.assert_allclose(truth.box.rotation[:, 0], [0, 1, 0])
    np.testing.assert_allclose(truth.box.center_m, [0, 0, 1])
    np.testing.assert_allclose(truth.box.size_m, [0.2, 0.1, 0.05])


def test_attributes_are_read_and_written(tmp_path: Path):
    values = {"glove": True, "fingers": 5, "length": 0.5, "side": "left"}
    boxes = read_boxes(write(tmp_path, {"a": [UNIT | {"attributes": values}, UNIT]}))
    assert [each.attributes for each in boxes["a"]] == [values, {}]
    write_boxes(tmp_path / "again.json", boxes)
    again = read_boxes(tmp_path / "again.json")["a"]
    assert [(each.attributes, type(each.attributes.get("fingers"))) for each in again] == [
        (values, int),
        ({}, type(None)),
    ]


@pytest.mark.shared
@pytest.mark.parametrize(("folder", "frames", "label"), [("hand_gesture", 24, "hand"), ("human_turn", 75, "human")])
def test_real_files_agree_with_their_own_corners(shared: Path, folder: str, frames: int, label: str):
    path = shared / "data" / folder / "boxes.json"
    boxes = read_boxes(path)
    assert len(boxes) == frames
    for key, entry in json.loads(path.read_text()).items():
        (truth,) = boxes[key]
        assert truth.label == label
        np.testing.assert_allclose(box_corners(truth.box), entry["corners"], atol=2e-6)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        pytest.param({"a": {"label": "hand"}}, "a.0.center: Field required", id="missing-key"),
        pytest.param({"a": [UNIT, UNIT | {"size": [1, 2]}]}, r"a\.1\.size", id="two-sizes"),
        pytest.param({"a": UNIT | {"size": [1, 0, 1]}}, "frame a, hand: box sizes must be positive", id="flat"),
        pytest.param({"a": UNIT | {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "proper rotation", id="mirror"),
        pytest.param({"a": UNIT | {"attributes": {"b": [1]}}}, r"a\.0\.attributes\.b", id="list-of-values"),
        pytest.param({"a": UNIT | {"corners": [[0, 0, 1]] * 8}}, "corners differ by up to", id="other-corners"),
        pytest.param('{"a": {"label": "x", "center": [0, NaN, 0]}}', "a.0.center.1", id="nan"),
    ],
)
def test_an_invalid_file_is_an_error(tmp_path: Path, content: object, complaint: str):
    path = write(tmp_path, content)
    with pytest.raises(FormatError, match=complaint) as caught:
        read_boxes(path)
    assert str(path) in str(caught.value)
