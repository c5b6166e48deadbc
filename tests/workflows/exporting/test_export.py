"""Export of a project: the selected labels are written, divided into parts; a failed export leaves nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from annotator.formats.losses import Lost
from annotator.formats.rcv import read_rcv
from annotator.formats.rcv_files import RcvManifest
from annotator.project import NewLabel, Origin, Project, RunShare, WriteContext
from annotator.recordings import open_recording
from annotator.types import (
    Box2D,
    BoxKind,
    DetectorKind,
    OrientedBox,
    Proposal,
    Quality,
    ReviewState,
    Source,
    Suggestion,
)
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.add_recordings import add_recordings
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.exporting.choose import Split, SplitBy, assign, parse_shares
from annotator.workflows.recorded.reading import load_truth

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
        ((ReviewState.REJECTED,), 2),
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
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.ones(3))
    found = Proposal("person", 0.5, box, Box2D("person", 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0))
    project.proposals.replace(stored.id, [found], WriteContext(0, "rcv", Source.AUTO), run=RunShare(run.id, 1.0))


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
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), np.eye(3), np.ones(3))
    drawn = [NewLabel("person", box, origin=Origin.DRAWN, suggestion=Suggestion("base detector", "b1"))]
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
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], tmp_path: Path, format: ExportFormat
) -> None:
    folder = own_copy("people")
    project = make_project(folder)
    label_all(project, (0, 3))
    depth = folder / "depth" / "000000.png"
    depth.write_bytes(depth.read_bytes()[:500])
    skip = ExportFilter(skip_unreadable=True)
    told: list[tuple[int, int]] = []
    progress = lambda done, total: told.append((done, total))  # noqa: E731
    report = export_project(project, tmp_path / "out", format, choose=skip, progress=progress)
    assert (report.frames, report.objects) == (1, 2)
    assert told == [(1, 4), (2, 4), (2, 2)], "two frames are read, and one is written"
    (left_out,) = report.unreadable
    assert left_out.startswith("people/000000: ") and "the PNG image is truncated" in left_out
    assert [loss.count for loss in report.losses if loss.kind is Lost.UNREADABLE] == [1]
    (folder / "depth" / "000003.png").write_bytes(b"")
    with pytest.raises(FrameError, match=r"depth/000000\.png"):
        export_project(project, tmp_path / "none", format, choose=skip)
    assert not (tmp_path / "none").exists()


def test_missing_frames_with_labels_fail_the_export(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    """Missing frames without labels are not exported; with labels they are an error."""
    folder = own_copy("people")
    project = make_project(folder)
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
