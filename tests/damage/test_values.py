"""What is written in another way is read as the same numbers, or refused; `scripts/fuzz values` tries many more."""

from __future__ import annotations

import pytest
from known_numbers import TARGETS, Target
from values import TEXTS, case, mutations


@pytest.mark.parametrize(("number", "target"), list(enumerate(TARGETS)), ids=[each.name for each in TARGETS])
def test_numbers_are_read_as_they_are_or_refused(number: int, target: Target) -> None:
    left_out = TEXTS.keys() - {list(TEXTS)[number % len(TEXTS)]}
    for mutation in mutations(target):
        if mutation not in left_out:
            kind, what = case(target, mutation, "quick")
            assert kind != "silent", f"{mutation}: {what}"
