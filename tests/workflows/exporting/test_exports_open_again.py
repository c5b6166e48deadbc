"""Exports open as recordings: clouds, images, cameras, up directions, times and labels are those of the project."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from annotator.geometry.oriented_box import box_corners
from annotator.project import Project
from annotator.recordings import Recording, detect_format, open_recording
from annotator.types import Frame
from annotator.types.errors import FrameError, RecordingError
from annotator.workflows.checking.dataset_check import check_datasets
from annotator.workflows.exporting import ExportFilter, ExportFormat, Split, export_project
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import Note
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import has_truth, load_truth

MakeProject = Callable[..., Project]
ALL = ExportFilter(empty_frames=True)
# Format, its reader, and how far corners of boxes and points may be off: KITTI's boxes lose the camera's tilt.
CASES = [
    pytest.param(ExportFormat.RCV, "rcv", 1e-6, 0.0, id="rcv"),
    pytest.param(ExportFormat.OPENLABEL, "openlabel", 1e-6, 0.0, id="openlabel"),
    pytest.param(ExportFormat.LABELCLOUD, "cloud_folder", 1e-6, 1e-5, id="labelcloud"),
    pytest.param(ExportFormat.KITTI, "kitti_object", 0.3, 1e-5, id="kitti"),
    pytest.param(ExportFormat.SUNRGBD, "sunrgbd_extracted", 1e-4, 1e-5, id="sunrgbd"),
]
# Formats that keep the image as it is, the up direction, and times.
LOSSLESS, KEEP_UP, KEEP_TIMES = {"rcv", "openlabel", "labelcloud", "kitti"}, {"rcv", "labelcloud", "sunrgbd"}, {"rcv"}


@pytest.fixture
def people(make_project: MakeProject, generated: Path) -> Project:
    """A project with the true boxes of the generated people."""
    project = make_project(generated / "people")
    import_own_labels(project, project.recordings.all()[0].id)
    return project


def in_order(project: Project, recording: Recording) -> Iterator[tuple[Frame, Frame, int, int]]:
    """Pairs of the exported frame that was opened and the project's frame; index of the former, id of the latter."""
    source = FrameSource(project)
    stored = project.frames.of()
    assert len(recording) == len(stored)
    for index, each in enumerate(stored):
        yield recording.frame(index), source.read(each), index, each.id


@pytest.mark.parametrize(("format", "reader", "box_m", "point_m"), CASES)
def test_an_export_opens_with_its_labels(
    people: Project, make_project: MakeProject, tmp_path: Path, format: ExportFormat, reader: str, box_m: float,
    point_m: float,
) -> None:  # fmt: skip
    report = export_project(people, tmp_path / "out", format, choose=ALL)
    recording = open_recording(tmp_path / "out")
    assert (recording.format, detect_format(tmp_path / "out"), recording.notes) == (reader, reader, ())
    assert has_truth(recording)
    boxes = 0
    for opened, known, index, frame_id in in_order(people, recording):
        assert (opened.camera.width_px, opened.camera.height_px) == (known.camera.width_px, known.camera.height_px)
        np.testing.assert_allclose(opened.camera.matrix, known.camera.matrix, atol=1e-9)
        np.testing.assert_allclose(opened.cloud.xyz_m, known.cloud.xyz_m, atol=point_m)
        np.testing.assert_array_equal(opened.cloud.rgb, known.cloud.rgb)
        if format.value in LOSSLESS:
            np.testing.assert_array_equal(opened.rgb, known.rgb)
        assert np.abs(opened.rgb.astype(int) - known.rgb).mean() < 3
        if format.value in KEEP_UP:
            np.testing.assert_allclose(opened.up, known.up, atol=1e-6)
        if format.value in KEEP_TIMES:
            assert opened.timestamp_ns == known.timestamp_ns
        labels, truths = people.labels.of_frame(frame_id), load_truth(recording, index, opened)
        assert [truth.label for truth in truths] == [label.label for label in labels]
        for truth, label in zip(truths, labels, strict=True):
            np.testing.assert_allclose(box_corners(truth.box), box_corners(label.box), atol=box_m)
        boxes += len(truths)
    assert boxes == report.objects >= 5
    again = make_project(tmp_path / "out")
    counts = import_own_labels(again, again.recordings.all()[0].id)
    assert (counts.boxes.total(), list(counts.of(Note.UNREADABLE))) == (report.objects, [])
    checked = check_datasets(tmp_path / "out")
    assert [(each.format, each.frames, each.labels) for each in checked.datasets] == [(reader, 5, report.objects)]
    assert "unchecked-dataset" not in {finding.rule for finding in checked.findings}


@pytest.mark.parametrize("format", [ExportFormat.OPENLABEL, ExportFormat.LABELCLOUD])
def test_a_part_of_a_divided_export_opens(people: Project, tmp_path: Path, format: ExportFormat) -> None:
    report = export_project(people, tmp_path / "out", format, choose=ALL, split=Split({"train": 0.6, "val": 0.4}))
    assert report.splits == {"train": 3, "val": 2}
    for part, frames in report.splits.items():
        recording = open_recording(tmp_path / "out" / part)
        assert len(recording) == frames
        assert sum(len(load_truth(recording, i, recording.frame(i))) for i in range(frames)) > 0


def test_several_recordings_are_one(make_project: MakeProject, generated: Path, tmp_path: Path) -> None:
    project = make_project(generated / "people", generated / "hands")
    for format, reader in ((ExportFormat.RCV, "rcv"), (ExportFormat.OPENLABEL, "openlabel")):
        report = export_project(project, tmp_path / reader, format, choose=ALL)
        recording = open_recording(tmp_path / reader)
        assert len(recording) == len(set(recording.keys)) == report.frames
        sizes = {recording.frame(i).rgb.shape for i in range(len(recording))}
        assert len(sizes) == len({FrameSource(project).read(each).rgb.shape for each in project.frames.of()})


def changed(path: Path, change: Callable[[dict[str, object]], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_damaged_exports_are_errors(people: Project, tmp_path: Path) -> None:
    rcv, openlabel = tmp_path / "rcv", tmp_path / "openlabel"
    export_project(people, rcv, ExportFormat.RCV, choose=ALL)
    export_project(people, openlabel, ExportFormat.OPENLABEL, choose=ALL)
    first = open_recording(rcv).keys[0]
    label = rcv / "labels" / f"{first}.json"
    for change, complaint in (
        (lambda record: record.update(image="../secret.png"), "file '../secret.png' leads out of the folder"),
        (lambda record: record.update(image="/x"), rf"{re.escape(str(rcv))}: .* '/x' leads out of the folder"),
        (lambda record: record.update(cloud="labels/x.json"), "is none of"),
        (lambda record: record.update(up=[0, 0, 0]), "up has length 0"),
        (lambda record: record.update(timestamp_ns=10**19), r"timestamp_ns: the time 1\d+ ns is beyond"),
        (lambda record: record["camera"].update(fx=-1), "camera.fx: Input should be greater"),
        (lambda record: record["camera"].update(width_px=7), "but its camera 7 x"),
    ):
        sound = label.read_text()
        changed(label, change)
        with pytest.raises(FrameError, match=complaint):
            open_recording(rcv).frame(0)
        label.write_text(sound)
        open_recording(rcv).frame(0)
    (document,) = openlabel.glob("*.json")
    changed(document, lambda content: content["openlabel"]["streams"]["camera"].pop("stream_properties"))
    with pytest.raises(RecordingError, match=r"is not a document of annotator \(KeyError 'stream_properties'\)"):
        open_recording(openlabel).frame(0)
    (rcv / "dataset.json").write_text('{"format": "annotator-rcv", "version": 1, "frames": []}')
    with pytest.raises(RecordingError, match="no frames"):
        open_recording(rcv)
    (rcv / "dataset.json").write_text('{"format": "other"}')
    assert detect_format(rcv) != "rcv"
