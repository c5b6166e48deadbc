"""Property tests try the same examples on every run, independent of other tests in the process."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st


def drawn() -> list[tuple[int, float, str, bytes]]:
    found: list[tuple[int, float, str, bytes]] = []

    @given(st.integers(), st.floats(allow_nan=False), st.text(), st.binary())
    def collect(whole: int, real: float, text: str, data: bytes) -> None:
        found.append((whole, real, text, data))

    collect()
    return found


def test_examples_depend_only_on_their_test(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = drawn()
    assert len(before) >= 20
    random.seed(1)
    assert drawn() == before
    # by default, Hypothesis also draws constants of loaded modules
    (tmp_path / "many_constants.py").write_text(f"NUMBERS = {[*range(1_000_003, 1_000_403)]}\n")
    monkeypatch.syspath_prepend(tmp_path)
    __import__("many_constants")
    assert drawn() == before
