"""Formats with full rotations: boxes are unchanged after export and import into another project."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from annotator.formats.dataset_writing import DatasetItem
from annotator.formats.labelcloud import write_labelcloud
from annotator.formats.losses import Losses
from annotator.formats.nuscenes import write_nuscenes
from annotator.formats.openlabel import write_openlabel
from annotator.formats.sustechpoints import write_sustechpoints
from annotator.geometry.oriented_box import box_corners
from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import Label, OrientedBox, ReviewState, Source
from annotator.workflows.exporting import ExportFilter, ExportFormat, ExportOptions, Split, export_project
from annotator.workflows.importing import BoxFormat, Note, import_labels, read_labels
from annotator.workflows.recorded.reading import load_truth

# Each format's precision, metres and radians.
CASES = [
    pytest.param(ExportFormat.OPENLABEL, ExportOptions(), 1e-9, id="openlabel"),
    pytest.param(ExportFormat.NUSCENES, ExportOptions(), 1e-9, id="nuscenes"),
    pytest.param(ExportFormat.LABELCLOUD, ExportOptions(), 2e-8, id="labelcloud"),
    pytest.param(ExportFormat.LABELCLOUD, ExportOptions(vertices=True), 2e-7, id="labelcloud vertices"),
    pytest.param(ExportFormat.SUSTECHPOINTS, ExportOptions(), 1e-12, id="sustechpoints"),
]


def label_freely(project: Project) -> None:
    """Creates boxes of any rotation on all frames except the last, and rejects the third one of each frame."""
    rng = np.random.default_rng(0)
    for number, stored in enumerate(project.frames.of()[:-1]):
        boxes = [
            OrientedBox.at(
                RigidTransform.from_components(rng.normal((0, 0, 3)), Rotation.random(rng=rng)),
                rng.uniform(0.1, 2, 3),
            )
            for _ in range(3)
        ]
        marks = zip(boxes, (0.5, None, 0.75), (1, None, 2), strict=True)
        new = [NewLabel("person", box, score, track) for box, score, track in marks]
        made = project.labels.create(stored.id, new, WriteContext(0, "me", Source.MANUAL))
        project.labels.reject(stored.id, made.uids[2], WriteContext(made.receipt.revision, f"me{number}"))


@pytest.mark.parametrize(("format", "options", "precision"), CASES)
def test_exported_boxes_are_imported_unchanged(
    people: Project,
    make_project: Callable[..., Project],
    generated: Path,
    tmp_path: Path,
    format: ExportFormat,
    options: ExportOptions,
    precision: float,
) -> None:
    label_freely(people)
    split = Split({"train": 0.5, "val": 0.5}, seed=1)
    report = export_project(people, tmp_path / "out", format, split=split, options=options)
    assert (report.frames, report.objects, report.splits) == (4, 8, {"train": 2, "val": 2})
    assert "tilt" not in {loss.kind for loss in report.losses}
    other = make_project(generated / "people")
    done = import_labels(other, read_labels(BoxFormat(format), tmp_path / "out"))
    assert (done.frames, done.boxes, tuple(done.of(Note.UNMATCHED))) == (4, {"person": 8}, ())
    assert_same(people, other, precision, tracks=format is not ExportFormat.LABELCLOUD)


def assert_same(before: Project, after: Project, precision: float, tracks: bool) -> None:
    for one, other in zip(before.frames.of(), after.frames.of(), strict=True):
        wanted = [each for each in before.labels.of_frame(one.id) if each.state is not ReviewState.REJECTED]
        found = after.labels.of_frame(other.id)
        assert [each.label for each in found] == [each.label for each in wanted]
        assert [each.track_id for each in found] == [each.track_id if tracks else None for each in wanted]
        for have, want in zip(found, wanted, strict=True):
            np.testing.assert_allclose(have.box.center_m, want.box.center_m, atol=precision)
            np.testing.assert_allclose(have.box.size_m, want.box.size_m, atol=precision)
            np.testing.assert_allclose(have.box.rotation, want.box.rotation, atol=precision)


def test_unaccepted_boxes_are_not_imported(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    """OpenLABEL stores the state and score of each box."""
    label_freely(people)
    choose = ExportFilter(states=(ReviewState.ACCEPTED, ReviewState.REJECTED))
    report = export_project(people, tmp_path / "out", ExportFormat.OPENLABEL, choose=choose)
    assert report.objects == 12
    other = make_project(generated / "people")
    done = import_labels(other, read_labels(BoxFormat.OPENLABEL, tmp_path / "out"))
    assert (done.boxes, done[Note.NOT_REVIEWED], done[Note.SCORE]) == ({"person": 8}, 4, 0)
    assert [x.score for x in other.labels.of_frame(other.frames.of()[0].id)] == [0.5, None]

    (document,) = (tmp_path / "out").glob("*.json")
    document.write_text(re.sub(r'("name":\s*"score",\s*"val":\s*)0\.5', r"\g<1>7.5", document.read_text(), count=1))
    raw = make_project(generated / "people")
    assert import_labels(raw, read_labels(BoxFormat.OPENLABEL, tmp_path / "out"))[Note.SCORE] == 4
    assert {x.score for stored in raw.frames.of() for x in raw.labels.of_frame(stored.id)} == {None}


@pytest.mark.shared
def test_boxes_of_real_frames_are_exported_and_read_unchanged(shared: Path, tmp_path: Path) -> None:
    """Frames of a LiDAR, of a tilted RGB-D camera, and of freely rotated hands: corners within 2e-8 m."""
    frames, truths, items = {}, {}, []
    for number, folder in enumerate(("kitti", "sunrgbd/sunrgbd_trainval", "hand_gesture")):
        recording = open_recording(shared / "data" / folder)
        frame = recording.frame(0)
        name = f"{number}/{frame.key}"
        frames[name], truths[name] = frame, load_truth(recording, 0, frame)
        labels = [
            Label(f"{i}", each.label, each.box, None, Source.IMPORTED, ReviewState.ACCEPTED, "me", 0)
            for i, each in enumerate(truths[name])
        ]
        items.append(DatasetItem(str(number), frame, labels))
    classes = sorted({each.label for boxes in truths.values() for each in boxes})
    write_openlabel(tmp_path / "openlabel", items, "annotator", "jpg")
    write_labelcloud(tmp_path / "labelcloud", items, classes, Losses(), "0", image_format="jpg")
    write_nuscenes(tmp_path / "nuscenes", items, classes, Losses(), image_format="jpg")
    write_sustechpoints(tmp_path / "sustechpoints", items, Losses(), image_format="jpg")
    for format in (BoxFormat.OPENLABEL, BoxFormat.LABELCLOUD, BoxFormat.NUSCENES, BoxFormat.SUSTECHPOINTS):
        found = read_labels(format, tmp_path / format)
        assert set(found.frames) == set(frames)
        for name, frame in frames.items():
            pairs = list(zip(found.truths(name, frame), truths[name], strict=True))
            assert pairs and all(have.label == want.label for have, want in pairs)
            for have, want in pairs:
                np.testing.assert_allclose(box_corners(have.box), box_corners(want.box), atol=2e-8)
