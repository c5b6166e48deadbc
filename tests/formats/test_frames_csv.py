"""frames.csv: round trips with any names, and errors that name the line."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.formats.frame_names import FrameOrigin, dump_frames, parse_frames, read_frames
from annotator.types.errors import FormatError

# file names contain no NUL and no lone surrogates
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=8)


@given(st.lists(st.builds(FrameOrigin, WORDS, WORDS, WORDS, st.none() | WORDS), unique_by=lambda o: o.id))
@settings(deadline=None)
def test_written_frames_read_back(origins: list[FrameOrigin]) -> None:
    assert list(parse_frames(Path("frames.csv"), dump_frames(origins)).values()) == origins


# Texts that spreadsheets run as formulas, and those that look like escaped ones.
FORMULAS = ["=1+1", "+a", "-a", "@a", "\t=a", "\ra", "\na", "'=a", "''@", "-1-1", "+1e", "'-5", '="x",y']


@pytest.mark.parametrize("name", FORMULAS)
def test_a_spreadsheet_runs_no_cell(name: str) -> None:
    text = dump_frames([FrameOrigin("a", name, name, name)])
    for cell in next(csv.reader(io.StringIO(text.partition("\r\n")[2], newline="")))[1:]:
        assert cell == f"'{name}"
    (read,) = parse_frames(Path("frames.csv"), text).values()
    assert read == FrameOrigin("a", name, name, name)


@pytest.mark.parametrize("name", ["-5", "+0.5e-3", "12", "a=b", "'a", "'", "''", "a-1"])
def test_numbers_and_other_texts_stay_as_they_are(name: str) -> None:
    text = dump_frames([FrameOrigin(name, name, name)])
    assert text.endswith(f"{name},{name},{name},\r\n")
    (read,) = parse_frames(Path("frames.csv"), text).values()
    assert read == FrameOrigin(name, name, name)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", r"frames\.csv:1: must begin with id,recording,key,split"),
        ("id,recording,key,split\n1,a,000,\n2,b\n", r"frames\.csv:3: needs the fields id, recording, key, split"),
        ("id,recording,key,split\n1,a,000,\n1,a,001,\n", r"frames\.csv:3: the id 1 occurs twice"),
        ('id,recording,key,split\n1,"a,000,\n', r"frames\.csv:2: is not valid CSV"),
    ],
)
def test_errors_name_the_line(text: str, problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        parse_frames(Path("frames.csv"), text)


def test_a_missing_or_unrelated_frames_csv_is_ignored(tmp_path: Path) -> None:
    assert read_frames(tmp_path) == {}
    (tmp_path / "frames.csv").write_text("time,exposure\n1,2\n")
    assert read_frames(tmp_path) == {}
    (tmp_path / "frames.csv").write_text("id,recording\n1,2\n")
    with pytest.raises(FormatError, match=r"frames\.csv:1: must begin with"):
        read_frames(tmp_path)
