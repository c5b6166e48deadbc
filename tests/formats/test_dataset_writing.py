"""Functions shared by the dataset writers: reports of losses, and errors of images that cannot be written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_samples import make_item

from annotator.formats.dataset_writing import FileNames, encoded_image, writing
from annotator.formats.losses import Losses, Lost
from annotator.formats.openlabel import write_openlabel
from annotator.types.errors import FormatError


def test_gravity_is_lost_unless_it_points_down_the_image(tmp_path: Path) -> None:
    losses = Losses()
    items = [make_item(), make_item(key="b", up=None), make_item(key="c", up=(1.0, 0.0, 0.0))]
    write_openlabel(tmp_path / "out", items, "annotator 1", losses=losses)
    assert [(loss.kind, loss.count) for loss in losses.report()] == [(Lost.GRAVITY, 1)]


def test_long_names_make_valid_file_names_that_differ(tmp_path: Path) -> None:
    names = FileNames()
    stems = [names.add("\N{GREEK SMALL LETTER OMEGA}" * 127, "k" * 190 + end) for end in ("1", "2", "1")]
    assert len(set(stems)) == 3
    for stem in stems:
        assert not stem.startswith(".")
        (tmp_path / f".{stem}.json.{'0' * 32}.tmp").touch()
    assert names.add("take", "000") == "take-000"


def test_an_image_too_large_for_its_format_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="an image of 70000 x 1 pixels is too large"), writing(tmp_path):
        encoded_image(np.zeros((1, 70000, 3), np.uint8), "jpg")
