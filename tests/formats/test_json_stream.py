"""Large JSON objects are read pair by pair, with the values and errors of reading them at once."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from annotator.formats import json_file
from annotator.formats.json_file import read_pairs
from annotator.types.errors import FormatError

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(st.characters(codec="utf-8")),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(st.characters(codec="utf-8")), inner),
    max_leaves=8,
)


@given(
    content=st.dictionaries(st.text(st.characters(codec="utf-8")), VALUES, max_size=4),
    indent=st.none() | st.integers(0, 2),
    is_ascii=st.booleans(),
    chunk=st.integers(1, 40),
    bom=st.booleans(),
)
def test_pairs_are_those_of_the_whole_file_wherever_its_parts_end(
    tmp_path_factory: pytest.TempPathFactory,
    content: dict[str, Any],
    indent: int | None,
    is_ascii: bool,
    chunk: int,
    bom: bool,
) -> None:
    path = tmp_path_factory.mktemp("json") / "content.json"
    text = json.dumps(content, indent=indent, ensure_ascii=is_ascii)
    path.write_text(f"\n {text}\n", encoding="utf-8-sig" if bom else "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(json_file, "CHUNK_BYTES", chunk)
        assert list(read_pairs(path)) == list(content.items())
        path.write_text(json.dumps({"meta": {"a": [1]}, "in": content, "end": 12}, ensure_ascii=is_ascii))
        assert list(read_pairs(path, "in")) == list(content.items())


@pytest.mark.parametrize("number", ["-1.5", "12e-3", "0.5E+10", "1e22"])
@pytest.mark.parametrize("chunk", range(1, 16))
def test_numbers_are_whole_wherever_a_part_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: str, chunk: int
) -> None:
    (tmp_path / "content.json").write_text(f'{{"a": {number}, "b": [{number}]}}')
    monkeypatch.setattr(json_file, "CHUNK_BYTES", chunk)
    assert list(read_pairs(tmp_path / "content.json")) == [("a", float(number)), ("b", [float(number)])]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "must be a JSON object"),
        ("[1]", "must be a JSON object"),
        ('{"a": 1', "Expecting ','"),
        ('{"a": 1,}', "a key in double quotes is missing"),
        ('{"a": 1} x', "after the end"),
        ('{"a"\n: 1,\n"b": [1,\n]}', "content.json:4: is not valid JSON"),
        ('{"a": tru', "Expecting value"),
        ('{"a": "b', "Unterminated string"),
        ('{"a": 1, "a": 2}', "'a' occurs twice"),
        ('{"a": {"b": 1, "b": 2}}', "'b' occurs twice"),
        ('{"a": "\\ud800"}', "unpaired surrogate"),
        ('{"a": ' + "1" * 5000 + "}", "cannot be read"),
        ('{"a": ' + "[" * 100_000, "nested too deeply"),
        ('{"a": "\xff"}', "not UTF-8"),
        ('{"a": [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14]}', "more than 0 MiB"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, problem: str
) -> None:
    path = tmp_path / "content.json"
    path.write_bytes(text.encode("latin-1"))
    if "MiB" in problem:
        monkeypatch.setattr(json_file, "CHUNK_BYTES", 4)
        monkeypatch.setattr(json_file, "MOST_VALUE", 20)
    with pytest.raises(FormatError, match=r"content\.json") as raised:
        list(read_pairs(path))
    assert problem in str(raised.value)
    with pytest.raises(FormatError):
        list(read_pairs(tmp_path / "missing.json"))
