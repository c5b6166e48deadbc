"""What an import tells: before it, in its report, and the sentences of both."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.formats.coco import CocoImage, write_coco
from annotator.project import NewLabel, Project, WriteContext
from annotator.types import Box2D, BoxKind, OrientedBox, ReviewState
from annotator.types.errors import FormatError
from annotator.workflows.importing import (
    Become,
    BoxFormat,
    FlatFormat,
    ImportReport,
    Note,
    Preview,
    import_labels,
    import_proposals,
    preview_boxes,
    read_labels,
)
from annotator.workflows.importing.report import _WORDS

ENTRY: dict[str, Any] = {"size": [4.0, 1.6, 1.5], "rotation": np.eye(3).tolist(), "center": [0.0, 0.0, 9.0]}


@pytest.fixture
def people(make_project: Callable[..., Project], generated: Path) -> Project:
    return make_project(generated / "people")


def test_every_note_has_words_and_several_details_are_cut() -> None:
    assert _WORDS.keys() == set(Note)
    report = ImportReport(Become.LABELS, ("person",), frames=2)
    report.boxes.update({"person": 3})
    report.add(Note.ALREADY, 0)
    report.add(Note.FLAT)
    report.add_all(Note.UNREADABLE, (f"{number}: torn" for number in range(7)))
    report.add(Note.OTHER_CLASS, 2, "Person")
    other = ImportReport(Become.LABELS, frames=1)
    other.add(Note.FLAT, 2)
    report.include(other)
    assert report.text(2) == (
        "imported as labels: 3 person in 3 frames; "
        "skipped: 3 rows with a 2D box and no 3D box (its height, width and length are -1); "
        "unreadable: 0: torn; unreadable: 1: torn; and 5 more like this; "
        "skipped: 2 boxes of class Person, which is not in the project; did you mean 'person'?"
    )
    assert len(report.sentences()) == 9


def test_frames_that_an_import_leaves_unchanged_are_told_before(people: Project, tmp_path: Path) -> None:
    """As labels: also those with proposals, and with rejected boxes only; as proposals: those that are finalised."""
    proposed, rejected, finalised, free = people.frames.of()[:4]
    box = OrientedBox.from_parts(np.array(ENTRY["center"]), np.eye(3), np.array(ENTRY["size"]))
    people.labels.create(rejected.id, [NewLabel("person", box, state=ReviewState.REJECTED)], WriteContext(0, "me"))
    people.frames.finalise(finalised.id, WriteContext(0, "me"))
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({proposed.key: [ENTRY | {"label": "person"}]}))
    import_proposals(people, read_labels(BoxFormat.BOXES, path))
    boxes = {frame.key: [ENTRY | {"label": "person", "score": 0.5}] for frame in (proposed, rejected, finalised, free)}
    path.write_text(json.dumps(boxes | {"elsewhere": []}))
    found = preview_boxes(people, path, BoxFormat.BOXES, None)
    assert (found.is_3d, found.boxes, found.scores and found.scores.low) == (True, {"person": 4}, 0.5)
    assert found.found == "4 3D boxes in 4 frames of this project."
    assert found.notes == (
        "2 of these frames have labels or proposals, and can only take proposals.",
        "1 of these frames is finalised, and left unchanged.",
        "Left out: 1 frame without a frame of the same name, such as elsewhere.",
    )
    assert import_labels(people, read_labels(BoxFormat.BOXES, path))[Note.ALREADY] == 3
    assert import_proposals(people, read_labels(BoxFormat.BOXES, path))[Note.FINALISED] == 1


def test_images_are_described_before_they_are_imported(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    box = Box2D("dog", 1.5, 1.5, 9.5, 9.5)
    first = people.frames.of()[0]
    people.boxes.set_on_image(first.id, [replace(box, label="person")], BoxKind.SILHOUETTE, WriteContext(0, "me"))

    def found(project: Project, *names: str, recording: str | None = None) -> Preview:
        write_coco(tmp_path / "c.json", [CocoImage(name, 320, 240, (box,)) for name in names])
        return preview_boxes(project, tmp_path / "c.json", FlatFormat.COCO, recording)

    before = people.log.last()
    shown = found(people, f"{first.key}.jpg", "x.jpg")
    assert (shown.found, shown.boxes) == ("1 box on 1 image of this project's frames.", {"dog": 1})
    assert shown.notes == (
        "The import replaces the boxes drawn on 1 image.",
        "Left out: 1 image without a frame of the same name, such as x.jpg.",
    )
    with pytest.raises(FormatError, match="none of the dataset's images has a frame in the project"):
        found(people, "x.jpg")
    with pytest.raises(FormatError, match=f"a/{first.key}.jpg and {first.key}.png both match frame {first.key}"):
        found(people, f"a/{first.key}.jpg", f"{first.key}.png")
    assert people.log.last() == before
    both = make_project(generated / "people", generated / "hands")
    assert found(both, f"{first.key}.jpg").ambiguous == 1
    assert found(both, f"{first.key}.jpg", recording="hands").ambiguous == 0
    (tmp_path / "frames.csv").write_text(f"id,recording,key,split\n0,other,{first.key},\n")
    assert found(people, "0.jpg").notes[-1] == "The file names a recording other, taken for people."
