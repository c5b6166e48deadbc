"""Reading masks of object numbers."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from annotator.formats.reading import read_mask
from annotator.types.errors import FormatError


def write(path: Path, mask: np.ndarray) -> Path:
    path.write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    return path


@pytest.mark.parametrize(
    ("written", "numbers"),
    [([0, 255], [0, 1]), ([0, 0], [0, 0]), ([0, 1], [0, 1]), ([0, 3], [0, 3]), ([2, 255], [2, 255])],
)
def test_object_numbers_are_read_and_a_single_255_becomes_1(tmp_path: Path, written: list[int], numbers: list[int]):
    mask = read_mask(write(tmp_path / "m.png", np.array([written], np.uint8)))
    assert mask.dtype == np.uint8
    assert mask.tolist() == [numbers]


@pytest.mark.shared
def test_a_real_mask_has_one_object(shared: Path):
    mask = read_mask(shared / "data" / "human_turn" / "mask" / "000000.png")
    assert mask.shape == (480, 640)
    assert set(np.unique(mask)) == {0, 1}


def test_a_truncated_mask_is_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    path = write(tmp_path / "m.png", np.random.default_rng(0).integers(0, 3, (50, 50)).astype(np.uint8))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(FormatError, match=r"m\.png: is not a valid mask: the PNG image is truncated"):
        read_mask(path)


@pytest.mark.parametrize("mask", [np.zeros((4, 4), np.uint16), np.zeros((4, 4, 3), np.uint8)])
def test_another_kind_of_image_is_an_error(tmp_path: Path, mask: np.ndarray):
    with pytest.raises(FormatError, match="one channel"):
        read_mask(write(tmp_path / "m.png", mask))


def test_a_missing_or_empty_mask_is_an_error(tmp_path: Path):
    with pytest.raises(FormatError, match="cannot be read"):
        read_mask(tmp_path / "none.png")
    (tmp_path / "empty.png").touch()
    with pytest.raises(FormatError, match="empty"):
        read_mask(tmp_path / "empty.png")
