"""Exports: what is chosen and divided; a failed one leaves nothing; they open again as recordings, and come back."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from store_samples import box_at, by_machine, proposal_at

from annotator.formats.dataset_writing import Lost
from annotator.formats.rcv import RcvManifest, read_rcv
from annotator.geometry.oriented_box import box_corners
from annotator.project import NewLabel, Origin, Project, RunShare, WriteContext
from annotator.recordings import Recording, detect_format, open_recording
from annotator.types import (
    BoxKind,
    DetectorKind,
    Frame,
    ReviewState,
    Source,
    Suggestion,
)
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.add_recordings import add_recordings
from annotator.workflows.checking.dataset_check import check_datasets
from annotator.workflows.exporting import ExportFilter, ExportFormat, Split, SplitBy, export_project, parse_shares
from annotator.workflows.exporting.choose import assign
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import BoxFormat, Note, import_labels, import_proposals, read_labels
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import has_truth, load_truth

STATES = (ReviewState.PROPOSED, ReviewState.ACCEPTED, ReviewState.EDITED, ReviewState.REJECTED)


def label_all(project: Project, indices: tuple[int, ...], recording: int = 0) -> None:
    """Creates accepted labels of the true boxes of some frames, and rejects the second one of each frame."""
    stored_recording = project.recordings.all()[recording]
    opened = open_recording(stored_recording.path)
    for index in indices:
        stored = project.frames.of([stored_recording.id])[index]
        truths = load_truth(opened, index, opened.frame(index))
        new = [NewLabel(t.label, t.box, track_id=t.track_id) for t in truths]
        made = project.labels.create(stored.id, new, WriteContext(0, "me", Source.IMPORTED))
        project.labels.reject(stored.id, made.uids[1], WriteContext(made.receipt.revision, "me"))


def exported(project: Project, out: Path, **options: object) -> RcvManifest:
    """Exports to the `rcv` format; returns the dataset's manifest."""
    report = export_project(project, out, **options)  # type: ignore[arg-type]
    manifest = read_rcv(out).manifest
    assert (report.frames, report.objects) == (manifest.counts.frames, manifest.counts.objects)
    assert report.objects_by_class == manifest.counts.objects_by_class and report.losses == ()
    return manifest


@pytest.mark.parametrize(
    ("states", "objects"),
    [
        ((ReviewState.ACCEPTED,), 4),
        (STATES, 6),
        ((ReviewState.PROPOSED, ReviewState.REJECTED), 2),
    ],
)
def test_only_labels_in_the_selected_states_are_exported(
    people: Project, tmp_path: Path, states: tuple[ReviewState, ...], objects: int
) -> None:
    label_all(people, (0, 1))
    manifest = exported(people, tmp_path / "out", choose=ExportFilter(states=states))
    assert manifest.counts.objects == objects
    assert {state for state, number in manifest.counts.objects_by_state.items() if number} <= set(states)


def test_frames_without_labels_are_exported_only_on_request(people: Project, tmp_path: Path) -> None:
    label_all(people, (1,))
    assert exported(people, tmp_path / "few").counts.frames == 1
    every = exported(people, tmp_path / "all", choose=ExportFilter(empty_frames=True))
    assert (every.counts.frames, every.counts.objects) == (5, 2)


def test_export_can_be_limited_to_classes_and_recordings(
    make_project: Callable[..., Project], generated: Path, own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    project = make_project(generated / "people", generated / "hands", classes=("person", "hand"))
    label_all(project, (0, 1), recording=0)
    label_all(project, (0, 2), recording=1)
    hands = project.recordings.find("hands")
    of_class = exported(project, tmp_path / "a", choose=ExportFilter(classes=("hand",)))
    of_recording = exported(project, tmp_path / "b", choose=ExportFilter(recordings=(hands.id,)))
    assert of_class.counts == of_recording.counts
    assert of_class.counts.objects_by_class == {"person": 0, "hand": 2}
    assert of_class.counts.frames_by_recording == {"hands": 2}
    assert of_class.classes == ("person", "hand"), "class numbers are those of the project"


def trained(project: Project, role: DetectorKind, name: str, fingerprint: str) -> None:
    weights = project.models_folder / role.value / name / "detector.pt"
    weights.parent.mkdir(parents=True)
    weights.write_bytes(b"weights")
    project.models.register(role, weights, labels=["person"], box_kind=BoxKind.BOX, metrics={}, fingerprint=fingerprint)


def propose_as(project: Project, index: int, image: str, view: str) -> None:
    """Creates a proposal on a frame, in a run of these detectors."""
    stored = project.frames.of()[index]
    run = project.jobs.start(image_detector=image, view_detector=view, config_json="{}")
    project.proposals.replace(stored.id, [proposal_at(label="person")], by_machine(), run=RunShare(run.id, 1.0))


def test_only_the_detectors_of_exported_boxes_are_named(people: Project, tmp_path: Path) -> None:
    trained(people, DetectorKind.IMAGE, "image-1", "i1")
    trained(people, DetectorKind.VIEW, "view-1", "v1")
    propose_as(people, 0, "i1", "v1")
    propose_as(people, 1, "from elsewhere", "v1")
    propose_as(people, 2, "i1", "rejected all")
    (rejected,) = people.labels.of_frame(people.frames.of()[2].id)
    people.labels.reject(people.frames.of()[2].id, rejected.uid, WriteContext(1, "me"))
    trained(people, DetectorKind.VIEW, "view-2", "v2")  # now active, but without proposals
    found = exported(people, tmp_path / "out").detectors
    assert [(detector.role, detector.name, detector.fingerprint) for detector in found] == [
        ("image", "image-1", "i1"),
        ("view", "view-1", "v1"),
        ("image", "unregistered", "from elsewhere"),
    ]


def test_the_detector_that_suggested_a_drawn_box_is_named(people: Project, tmp_path: Path) -> None:
    drawn = [NewLabel("person", box_at(), origin=Origin.DRAWN, suggestion=Suggestion("base detector", "b1"))]
    people.labels.create(people.frames.of()[0].id, drawn, WriteContext(0, "me"))
    (found,) = exported(people, tmp_path / "out").detectors
    assert (found.role, found.name, found.fingerprint) == ("view", "base detector", "b1")


@pytest.mark.parametrize(
    ("choose", "problem"),
    [
        (ExportFilter(), "has no labels in state proposed, accepted, edited to export; run `annotator annotate` first"),
        (ExportFilter(classes=("robot",)), "has no class 'robot'; it has: person"),
        (ExportFilter(states=(ReviewState.EDITED,)), "has no labels in state edited to export"),
    ],
)
def test_an_empty_export_is_an_error(people: Project, tmp_path: Path, choose: ExportFilter, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        exported(people, tmp_path / "out", choose=choose)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("format", [ExportFormat.RCV, ExportFormat.KITTI, ExportFormat.COCO])
def test_unreadable_frames_are_left_out_on_request(
    copied: tuple[Path, Project], tmp_path: Path, format: ExportFormat
) -> None:
    folder, project = copied
    label_all(project, (0, 3))
    depth = folder / "depth" / "000000.png"
    depth.write_bytes(depth.read_bytes()[:500])
    skip = ExportFilter(skip_unreadable=True)
    with pytest.raises(FrameError, match=r"depth/000000\.png"):
        export_project(project, tmp_path / "out", format)
    report = export_project(project, tmp_path / "out", format, choose=skip)
    assert (report.frames, report.objects) == (1, 2)
    (left_out,) = report.unreadable
    assert left_out.startswith("people/000000: ") and "the image is damaged or truncated" in left_out
    assert [loss.count for loss in report.losses if loss.kind is Lost.UNREADABLE] == [1]
    (folder / "depth" / "000003.png").write_bytes(b"")
    with pytest.raises(FrameError, match=r"depth/000000\.png"):
        export_project(project, tmp_path / "none", format, choose=skip)
    assert not (tmp_path / "none").exists()


def test_missing_frames_with_labels_fail_the_export(copied: tuple[Path, Project], tmp_path: Path) -> None:
    folder, project = copied
    label_all(project, (0, 1))
    for name in ("color/000004.jpg", "depth/000004.png"):
        (folder / name).unlink()
    add_recordings(project, [folder])
    assert exported(project, tmp_path / "a", choose=ExportFilter(empty_frames=True)).counts.frames == 4
    for name in ("color/000001.jpg", "depth/000001.png"):
        (folder / name).unlink()
    add_recordings(project, [folder])
    with pytest.raises(FrameError, match="frame 000001 no longer exists; restore it"):
        exported(project, tmp_path / "b")
    assert not (tmp_path / "b").exists()


PLACES = [(recording, f"{number:06d}") for recording in ("a", "b", "c", "d") for number in range(25)]
SHARES = {"train": 0.7, "val": 0.2, "test": 0.1}


def test_the_split_depends_on_the_seed_but_not_on_the_order_of_frames() -> None:
    parts = dict(zip(PLACES, assign(Split(SHARES), PLACES), strict=True))
    assert Counter(parts.values()) == {"train": 70, "val": 20, "test": 10}
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


@pytest.mark.parametrize(
    "text", ["", "train", "train=", "train=x", "train=0", "train=-1,val=2", "a=1,a=1", "../x=1", "a=inf", "a=nan"]
)
def test_invalid_shares_are_errors(text: str) -> None:
    with pytest.raises(ConfigError, match="is not a valid split"):
        parse_shares(text)


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
def labelled_people(make_project: MakeProject, generated: Path) -> Project:
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
    labelled_people: Project,
    make_project: MakeProject,
    tmp_path: Path,
    format: ExportFormat,
    reader: str,
    box_m: float,
    point_m: float,
) -> None:
    report = export_project(labelled_people, tmp_path / "out", format, choose=ALL)
    recording = open_recording(tmp_path / "out")
    assert (recording.format, detect_format(tmp_path / "out"), recording.notes) == (reader, reader, ())
    assert has_truth(recording)
    boxes = 0
    for opened, known, index, frame_id in in_order(labelled_people, recording):
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
        labels, truths = labelled_people.labels.of_frame(frame_id), load_truth(recording, index, opened)
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


def test_a_frame_of_an_export_that_contradicts_itself_is_refused(labelled_people: Project, tmp_path: Path) -> None:
    export_project(labelled_people, tmp_path / "out", choose=ALL)
    recording = open_recording(tmp_path / "out")
    file = tmp_path / "out/labels" / f"{recording.keys[0]}.json"
    record = json.loads(file.read_text())
    for change, problem in (
        ({"up": [0, 0, 0]}, "up has length 0"),
        ({"timestamp_ns": 10**19}, r"timestamp_ns: the time 1\d+ ns is beyond"),
        ({"image": "../secret.png"}, "leads out of the folder"),
        ({"camera": record["camera"] | {"width_px": 7}}, "but its camera has 7 x"),
    ):
        file.write_text(json.dumps(record | change))
        with pytest.raises(FrameError, match=problem):
            recording.frame(0)


@pytest.mark.parametrize("format", [ExportFormat.RCV, ExportFormat.OPENLABEL, ExportFormat.LABELCLOUD])
def test_a_part_of_a_divided_export_opens_or_is_a_list_of_its_frames(
    labelled_people: Project, tmp_path: Path, format: ExportFormat
) -> None:
    report = export_project(
        labelled_people, tmp_path / "out", format, choose=ALL, split=Split({"train": 0.6, "val": 0.4})
    )
    assert report.splits == {"train": 3, "val": 2}
    for part, frames in report.splits.items():
        if format is ExportFormat.RCV:
            assert len((tmp_path / f"out/splits/{part}.txt").read_text().split()) == frames
            continue
        recording = open_recording(tmp_path / "out" / part)
        assert len(recording) == frames
        assert sum(len(load_truth(recording, i, recording.frame(i))) for i in range(frames)) > 0


BOX = {"label": "person", "size": [0.5, 0.4, 1.8], "rotation": [[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]}


def propose(project: Project, tmp_path: Path, source: str, **fields: Any) -> dict[str, int]:
    entry = BOX | {"center": [0.2, 0.1, 3.0]} | fields
    path = tmp_path / f"{source}.json"
    path.write_text(json.dumps({project.frames.of()[0].key: [entry]}))
    done = import_proposals(project, read_labels(BoxFormat.BOXES, path), source)
    return dict(done.of(Note.VALUE))


def test_sources_keep_the_names_of_renamed_classes_and_nothing_of_unknown_ones(
    make_project: MakeProject, generated: Path, tmp_path: Path
) -> None:
    """Of a box that two detectors had proposed."""
    reviewed = make_project(generated / "people")
    propose(reviewed, tmp_path, "centerpoint v2", score=0.9, track=7)
    propose(reviewed, tmp_path, "my own", score=0.4, center=[0.25, 0.1, 3.0])
    (entry,) = reviewed.labels.select()
    frame = reviewed.frames.get(entry.frame_id)
    reviewed.labels.accept(frame.id, entry.label.uid, WriteContext(frame.revision, "me"))
    export_project(reviewed, tmp_path / "out", ExportFormat.RCV, choose=ExportFilter())
    (file,) = (tmp_path / "out" / "labels").iterdir()
    content = json.loads(file.read_text())
    content["objects"][0]["said"][1]["label"] = "chair"
    file.write_text(json.dumps(content))
    project = make_project(generated / "people", classes=("human",))
    import_labels(project, read_labels(BoxFormat.RCV, tmp_path / "out"), names={"person": "human"})
    (entry,) = project.labels.select()
    assert [(each.source, each.label) for each in entry.said] == [("centerpoint v2", "human")]


def attributes(project: Project) -> dict[str, Any]:
    (entry,) = project.labels.select()
    return dict(entry.label.attributes)
