"""SUN RGB-D: export from a project, import into another one, and opening the export as a recording."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.formats.sunrgbd.meta_table import META
from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import OrientedBox, Source
from annotator.workflows.exporting import ExportFilter, ExportFormat, Split, export_project
from annotator.workflows.importing import BoxFormat, Note, import_labels, read_labels
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import load_truth

MakeProject = Callable[..., Project]
ALL = ExportFilter(empty_frames=True)


def boxes(project: Project) -> list[tuple[str, OrientedBox]]:
    return [(x.label, x.box) for f in project.frames.of() for x in project.labels.of_frame(f.id)]


def assert_same(found: list[tuple[str, OrientedBox]], expected: list[tuple[str, OrientedBox]], atol: float) -> None:
    for (label, box), (name, other) in zip(found, expected, strict=True):
        assert label == name
        np.testing.assert_allclose(box.pose, other.pose, atol=atol)
        np.testing.assert_allclose(box.size_m, other.size_m, atol=atol)


def test_a_sunrgbd_export_can_be_imported_and_opened_as_a_recording(
    make_project: MakeProject, generated: Path, tmp_path: Path
) -> None:
    """Tilted boxes are upright in the labels but tilted in the table; keys of six digits are kept."""
    people = make_project(generated / "people")
    import_own_labels(people, people.recordings.all()[0].id)
    first = people.frames.of()[0]
    leaning = OrientedBox.from_parts(
        np.array([0.0, 0.1, 3.0]), Rotation.from_euler("xyz", [0.3, 0.4, 0.2]).as_matrix(), np.array([0.5, 0.6, 0.7])
    )
    new = [NewLabel("person", leaning)]
    people.labels.create(first.id, new, WriteContext(people.frames.get(first.id).revision, "me", Source.MANUAL))
    out = tmp_path / "out"
    report = export_project(people, out, ExportFormat.SUNRGBD, choose=ALL, split=Split({"train": 0.6, "val": 0.4}))
    losses = {loss.kind.value: loss for loss in report.losses}
    assert losses["tilt"].count == 1
    assert (losses["tilt"].most or 0.0) > 0.05
    assert sum(len(path.read_text().split()) for path in out.glob("*_data_idx.txt")) == 5

    seen = boxes(people)
    assert report.objects == len(seen)
    from_table, from_labels = make_project(generated / "people"), make_project(generated / "people")
    done = import_labels(from_table, read_labels(BoxFormat.SUNRGBD, out / META))
    assert (done.frames, tuple(done.of(Note.UNMATCHED))) == (5, ())
    assert_same(boxes(from_table), seen, 1e-9)
    import_labels(from_labels, read_labels(BoxFormat.SUNRGBD, out))
    again = export_project(from_labels, tmp_path / "again", ExportFormat.SUNRGBD, choose=ALL)
    assert "tilt" not in {loss.kind.value for loss in again.losses}
    for file in (out / "label").iterdir():
        ours, theirs = (
            np.array([line.split()[1:] for line in (folder / file.name).read_text().splitlines()], float)
            for folder in (out / "label", tmp_path / "again" / "label")
        )
        np.testing.assert_allclose(ours[:, 4:10], theirs[:, 4:10], atol=1e-9)
        np.testing.assert_allclose(ours, theirs, atol=1e-3)

    opened, known = open_recording(out), open_recording(generated / "people")
    assert (opened.format, opened.keys) == ("sunrgbd_extracted", known.keys)
    frame, original = opened.frame(0), known.frame(0)
    np.testing.assert_allclose(frame.camera.matrix, original.camera.matrix, atol=1e-9)
    np.testing.assert_allclose(frame.up, original.up, atol=1e-9)
    np.testing.assert_allclose(frame.cloud.xyz_m, original.cloud.xyz_m, atol=1e-5)
    np.testing.assert_array_equal(frame.cloud.rgb, original.cloud.rgb)
    np.testing.assert_array_equal(frame.cloud.pixel_index, original.cloud.pixel_index)
    truths = [(t.label, t.box) for i in range(5) for t in load_truth(opened, i, opened.frame(i))]
    assert_same(truths, boxes(from_labels), 1e-6)


@pytest.mark.shared
def test_real_labels_are_exported_unchanged(make_project: MakeProject, shared: Path, tmp_path: Path) -> None:
    """VoteNet's numbers of a real frame: the 3D values are unchanged up to the last digit."""
    root = shared / "data" / "sunrgbd" / "sunrgbd_trainval"
    original = (root / "label" / "000001.txt").read_text().splitlines()
    classes = sorted({line.split()[0] for line in original})
    project = make_project(root, classes=classes)
    labels: Path = root
    for trip in range(2):
        import_labels(project, read_labels(BoxFormat.SUNRGBD, labels))
        labels = tmp_path / f"trip{trip}"
        report = export_project(project, labels, ExportFormat.SUNRGBD)
        assert {loss.kind.value for loss in report.losses} == set()
        for mine, theirs in zip((labels / "label" / "000001.txt").read_text().splitlines(), original, strict=True):
            ours, known = mine.split(), theirs.split()
            assert ours[0] == known[0]
            np.testing.assert_allclose(np.array(ours[5:], float), np.array(known[5:], float), atol=1.01e-6)
        project = make_project(root, classes=classes)
