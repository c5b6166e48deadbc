"""Damaged files give a frame or labels, or an error that names a file; `scripts/fuzz files` tries more of them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from search import examine, one_damaged
from targets import TARGETS, Target
from time_limit import time_limit

from annotator.formats.table import BoxFormat, FlatFormat
from annotator.recordings import detect_format
from annotator.recordings.open import READERS
from annotator.types.errors import RecordingError

FEW = 4


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_damaged_files_are_read_or_refused(target: Target, tmp_path: Path):
    folder = tmp_path / "take_freiburg"
    folder.mkdir()
    target.build(folder)
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    target.read(folder)
    for number in range(FEW):
        with one_damaged(folder, files, f"quick {target.name} {number}") as file, time_limit(60):
            problem = examine(target, folder)["problem"]
            assert not problem, f"{file}, number {number}: {problem}"


def test_every_reader_and_format_is_tried(tmp_path: Path):
    found = set()
    for target in TARGETS:
        folder = tmp_path / f"{target.name}_freiburg"
        folder.mkdir()
        target.build(folder)
        places = (folder, *folder.iterdir()) if folder.is_dir() else ()
        for place in places:
            # exports of labels are no recordings, or lack images
            with suppress(RecordingError):
                found.add(detect_format(place))
    assert found >= READERS.keys()
    names = {target.name for target in TARGETS}
    assert names >= {f"export_{format.replace('-', '_')}" for format in BoxFormat} | set(FlatFormat)
