"""frames.csv: round trips with any names, and errors that name the line."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from annotator.formats.frames_csv import FrameOrigin, dump_frames, parse_frames, read_frames
from annotator.types.errors import FormatError

# file names contain no NUL and no lone surrogates
WORDS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1, max_size=8)


@given(st.lists(st.builds(FrameOrigin, WORDS, WORDS, WORDS, st.none() | WORDS), unique_by=lambda o: o.id))
@settings(deadline=None)
def test_written_frames_read_back(origins: list[FrameOrigin]) -> None:
    assert list(parse_frames(Path("frames.csv"), dump_frames(origins)).values()) == origins


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
