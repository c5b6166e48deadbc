"""Text and numbers of files as people's tools write them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from annotator.files import open_text_file, read_text_file
from annotator.formats.reading import read_text
from annotator.text import NotTextError, decoded, to_number
from annotator.types.errors import FormatError

TEXT = "0 ä\n1 é\n"


@pytest.mark.parametrize(
    "content",
    [
        TEXT.encode(),
        TEXT.encode("utf-8-sig"),
        TEXT.encode("utf-16"),
        b"\xfe\xff" + TEXT.encode("utf-16-be"),
        TEXT.encode("utf-32"),
        TEXT.replace("\n", "\r\n").encode("utf-8-sig"),
        TEXT.replace("\n", "\r").encode(),
    ],
    ids=["utf-8", "mark", "utf-16", "utf-16-be", "utf-32", "crlf", "cr"],
)
def test_marks_and_line_ends_of_other_systems_are_read(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(content)
    assert read_text_file(path) == TEXT
    assert read_text(path).splitlines() == TEXT.splitlines()
    with open_text_file(path, 100) as file:
        assert file.read() == TEXT


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("a\nä".encode("latin-1"), r"not UTF-8 text in line 2 \(0xe4\); save it as UTF-8"),
        (b"\x80", r"not UTF-8 text in line 1 \(0x80\)"),
        ("ä".encode("utf-16")[:-1], "not UTF-16 text in line 1"),
    ],
)
def test_other_encodings_are_refused_with_their_place(tmp_path: Path, content: bytes, says: str) -> None:
    with pytest.raises(NotTextError, match=says):
        decoded(content)
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(FormatError, match=rf"a\.txt: is {says}"):
        read_text(tmp_path / "a.txt")


@pytest.mark.parametrize(
    ("text", "value"), [("1", 1.0), ("-1.5", -1.5), (" 2e-3 ", 2e-3), (".5", 0.5), ("inf", math.inf), ("+0", 0.0)]
)
def test_numbers(text: str, value: float) -> None:
    assert to_number(text) == value


@pytest.mark.parametrize(
    ("text", "has_comma"),
    [
        ("0,5", True),
        ("-1,50", True),
        (",5", True),
        ("1,", True),
        ("1.234,5", True),
        ("1,5e-3", True),
        ("1,5;2,5", True),
        ("1,2,3", False),
        ("1_000", False),
        ("x", False),
        ("", False),
    ],
)
def test_what_is_no_number_is_quoted_and_a_decimal_comma_is_named(text: str, has_comma: bool) -> None:
    says = "has a decimal comma; write a point" if has_comma else "is not a number"
    with pytest.raises(ValueError, match=f"^'{text}' {says}$"):
        to_number(text)
