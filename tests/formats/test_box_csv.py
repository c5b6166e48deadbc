"""Reading CSV files of boxes, and the errors of damaged ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from annotator.formats.box_csv import BoxRow, read_box_csv
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


def test_columns_may_have_any_order(tmp_path: Path) -> None:
    pairs = list(zip(HEAD.split(","), ROW.split(","), strict=True))[::-1]
    path = file_of(tmp_path, ",".join(name for name, _ in pairs), ",".join(value for _, value in pairs))
    assert read_box_csv(path, scored=True)[0].center_m == (-0.5, 3.25, -0.75)


BROKEN = [
    pytest.param([], 1, "image is missing", id="empty"),
    pytest.param([HEAD.removesuffix(",score"), ROW], 1, "has no column score", id="no-score"),
    pytest.param([HEAD + ",colour", ROW], 1, "'colour' is unknown", id="unknown-column"),
    pytest.param([HEAD + ",yaw", ROW], 1, "two columns have the same name", id="column-twice"),
    pytest.param([HEAD, ROW, "3,bed"], 3, "has 2 fields", id="too-few"),
    pytest.param([HEAD, ROW + ",1"], 2, "has 11 fields", id="too-many"),
    pytest.param([HEAD, ROW.replace("-0.75", "-0,75")], 2, "numbers need a decimal point", id="comma"),
    pytest.param([HEAD, ROW.replace("-0.75", "low")], 2, "cz: 'low' is not a number", id="text"),
    pytest.param([HEAD, ROW.replace("-0.75", "1_0")], 2, "cz: '1_0' is not a number", id="underscore"),
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
