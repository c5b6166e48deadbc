"""Splitting a dataset: fractions, seeds, whole recordings, and any order of frames."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from annotator.types.errors import ConfigError
from annotator.workflows.exporting.choose import Split, SplitBy, assign, parse_shares

PLACES = [(recording, f"{number:06d}") for recording in ("a", "b", "c", "d") for number in range(25)]
SHARES = {"train": 0.7, "val": 0.2, "test": 0.1}


def test_split_sizes_match_the_shares() -> None:
    assert Counter(assign(Split(SHARES), PLACES)) == {"train": 70, "val": 20, "test": 10}


def test_the_split_depends_on_the_seed_but_not_on_the_order_of_frames() -> None:
    parts = dict(zip(PLACES, assign(Split(SHARES), PLACES), strict=True))
    shuffled = [PLACES[i] for i in np.random.default_rng(3).permutation(len(PLACES))]
    assert dict(zip(shuffled, assign(Split(SHARES), shuffled), strict=True)) == parts
    assert dict(zip(PLACES, assign(Split(SHARES, seed=1), PLACES), strict=True)) != parts


def test_recordings_are_not_divided() -> None:
    split = Split({"train": 0.75, "val": 0.25}, SplitBy.RECORDINGS)
    parts = assign(split, PLACES)
    assert len({(recording, part) for (recording, _), part in zip(PLACES, parts, strict=True)}) == 4
    assert Counter(parts) == {"train": 75, "val": 25}


def test_no_part_is_empty() -> None:
    assert set(assign(Split({"train": 0.98, "val": 0.02}), PLACES[:5])) == {"train", "val"}
    with pytest.raises(ConfigError, match="2 recordings cannot be divided into 3 parts"):
        assign(Split(SHARES, SplitBy.RECORDINGS), PLACES[:50])


def test_equal_shares_give_the_same_split_in_every_process() -> None:
    """The order of sets of strings differs between processes."""
    shares = dict.fromkeys(("train", "val", "test"), 1 / 3)
    assert assign(Split(shares), [("a", "1"), ("a", "2"), ("a", "3")]) == ["val", "test", "train"]


def test_shares_are_parsed() -> None:
    assert parse_shares("train=4, val=1") == {"train": 0.8, "val": 0.2}


@pytest.mark.parametrize(
    "text", ["", "train", "train=", "train=x", "train=0", "train=-1,val=2", "a=1,a=1", "../x=1", "a=inf", "a=nan"]
)
def test_invalid_shares_are_errors(text: str) -> None:
    with pytest.raises(ConfigError, match="is not a valid split"):
        parse_shares(text)
