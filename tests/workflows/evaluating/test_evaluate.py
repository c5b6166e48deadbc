"""Evaluation of files and projects: matching frames are compared, mismatches are errors."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from annotator.evaluation.report import Report
from annotator.project import NewLabel, Project, WriteContext
from annotator.recordings import open_recording
from annotator.types import Box2D, OrientedBox, Proposal, Quality, ReviewState, Source
from annotator.types.errors import ConfigError, FormatError
from annotator.workflows.evaluate import (
    Against,
    Measured,
    Options,
    Protocol,
    evaluate_files,
    evaluate_project,
    read_frame_names,
)
from annotator.workflows.exporting import ExportFilter, export_project
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.recorded.reading import load_truth

CAR = "{} 0.00 0 0.10 {} 120.00 {} 180.00 1.50 1.60 4.00 {} 1.60 20.00 0.20"


def content(report: Report) -> dict:
    return json.loads(report.content.model_dump_json())


def kitti_folders(tmp_path: Path, frames: int = 3) -> tuple[Path, Path]:
    """Frames with two cars each, which are detected exactly."""
    paths = tmp_path / "found", tmp_path / "label_2"
    for path in paths:
        path.mkdir()
        for number in range(frames):
            rows = [CAR.format("Car", x, x + 90, x / 50) for x in (100, 400)]
            scores = [f" 0.{9 - number}{k}" if path is paths[0] else "" for k in (1, 2)]
            text = "\n".join(row + score for row, score in zip(rows, scores, strict=True))
            (path / f"{number:06d}.txt").write_text(text + "\n")
    return paths


def test_exact_kitti_detections_have_full_precision(tmp_path: Path) -> None:
    report = evaluate_files(*kitti_folders(tmp_path), Protocol.KITTI)
    assert list(content(report)) == ["Car"]
    assert list(content(report)["Car"]) == ["bbox", "aos", "bev", "3d"]
    for ap in content(report)["Car"].values():
        # with six objects, precision is above 0 at the recall samples 0 to 5 only
        assert ap == {"R11": pytest.approx([200 / 11] * 3), "R40": pytest.approx([12.5] * 3)}
    assert [row[:2] for row in report.rows] == [("Car", "bbox"), ("Car", "aos"), ("Car", "bev"), ("Car", "3d")]
    assert len(report.diagrams) == 4


def test_the_truth_of_kitti_may_be_a_whole_dataset(tmp_path: Path) -> None:
    found, truth = kitti_folders(tmp_path)
    (tmp_path / "dataset" / "training").mkdir(parents=True)
    truth.rename(tmp_path / "dataset" / "training" / "label_2")
    assert list(content(evaluate_files(found, tmp_path / "dataset", Protocol.KITTI))) == ["Car"]


def test_kitti_frames_must_match(tmp_path: Path) -> None:
    found, truth = kitti_folders(tmp_path)
    (found / "000001.txt").unlink()
    with pytest.raises(ConfigError, match=r"000001\.txt is missing\. Write an empty file"):
        evaluate_files(found, truth, Protocol.KITTI)
    split = Options(frames=["000000", "000002"])
    assert content(evaluate_files(found, truth, Protocol.KITTI, split))["Car"]["3d"]["R40"][0] == pytest.approx(7.5)
    with pytest.raises(ConfigError, match=r"found: has no file 000001\.txt"):
        evaluate_files(found, truth, Protocol.KITTI, Options(frames=["000001"]))
    (truth / "000002.txt").unlink()
    with pytest.raises(ConfigError, match=r"label_2: has no file 000002\.txt"):
        evaluate_files(found, truth, Protocol.KITTI)


HEAD = "image,class,cx,cy,cz,l,w,h,yaw"


def csv_files(tmp_path: Path) -> tuple[Path, Path]:
    """A bed found, a chair missed, a false table, and an image without truth."""
    found, truth = tmp_path / "found.csv", tmp_path / "truth.csv"
    truth.write_text(f"{HEAD}\n1,bed,0,0,0,2,1.5,0.5,0.3\n1,chair,3,0,0,1,1,1,0\n")
    rows = ["1,bed,0.1,0,0,2,1.5,0.5,0.3,0.9", "1,table,0,0,0,1,1,1,0,0.8", "2,bed,0,0,0,2,1.5,0.5,0.3,0.95"]
    found.write_text("\n".join([HEAD + ",score", *rows]) + "\n")
    return found, truth


def test_sunrgbd_files_are_evaluated_and_mismatches_are_errors(tmp_path: Path) -> None:
    report = evaluate_files(*csv_files(tmp_path), Protocol.SUNRGBD)
    assert content(report) == {key: {"mAP": 0.25, "AP": {"bed": 0.5, "chair": 0.0}} for key in ("0.15", "0.25", "0.5")}
    assert [row[0] for row in report.rows] == ["bed", "chair", "mean"]
    chosen = evaluate_files(*csv_files(tmp_path), Protocol.SUNRGBD, Options(frames=["1"]))
    assert content(chosen)["0.25"] == {"mAP": 0.5, "AP": {"bed": 1.0, "chair": 0.0}}
    with pytest.raises(ConfigError, match=r"truth\.csv: has no true boxes"):
        evaluate_files(*csv_files(tmp_path), Protocol.SUNRGBD, Options(frames=["2"]))
    with pytest.raises(ConfigError, match=r"none of the names to evaluate \(first: 7\)"):
        evaluate_files(*csv_files(tmp_path), Protocol.SUNRGBD, Options(frames=["7"]))
    found, truth = csv_files(tmp_path)
    truth.write_text(truth.read_text().replace("\n1,", "\n000001,"))
    with pytest.raises(ConfigError, match="no frame in common"):
        evaluate_files(found, truth, Protocol.SUNRGBD)


def test_frame_names_come_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "val.txt").write_text("000001\r\n\n000004\n")
    assert read_frame_names(tmp_path / "val.txt") == ["000001", "000004"]
    (tmp_path / "none.txt").write_text("\n")
    for name, problem in (("none.txt", "contains no frame name"), ("missing.txt", "cannot be read")):
        with pytest.raises(FormatError, match=problem):
            read_frame_names(tmp_path / name)


def moved(box: OrientedBox, share: float) -> OrientedBox:
    """The box shifted along its x axis by a fraction of its length: IoU (1 - share) / (1 + share)."""
    shift = box.rotation @ (np.array([share, 0, 0]) * box.size_m)
    return OrientedBox.from_parts(box.center_m + shift, box.rotation, box.size_m)


def true_boxes(project: Project, index: int) -> list[tuple[str, OrientedBox]]:
    recording = open_recording(project.recordings.all()[0].path)
    return [(truth.label, truth.box) for truth in load_truth(recording, index, recording.frame(index))]


def label(project: Project, index: int, share: float = 0.0, state: ReviewState = ReviewState.ACCEPTED) -> None:
    """Labels a frame with its true boxes, shifted."""
    stored = project.frames.of()[index]
    new = [NewLabel(name, moved(box, share), state=state) for name, box in true_boxes(project, index)]
    project.labels.create(stored.id, new, WriteContext(project.frames.get(stored.id).revision, "me"))


def propose(project: Project, index: int, share: float) -> None:
    stored = project.frames.of()[index]
    proposals = [
        Proposal(name, 0.5, moved(box, share), Box2D(name, 1.0, 1.0, 9.0, 9.0), (), Quality(0.0, 1.0, 0.0))
        for name, box in true_boxes(project, index)
    ]
    project.proposals.replace(stored.id, proposals, WriteContext(stored.revision, "rcv", Source.AUTO))


def test_labels_are_evaluated_against_the_recordings_truth(people: Project) -> None:
    label(people, 0, state=ReviewState.REJECTED)
    found = content(evaluate_project(people, Protocol.ORIENTED))["classes"]["person"]
    assert (found["objects"], found["detections"], found["rotation_error_rad"]) == (3, 0, None), (
        "only their frame counts"
    )
    label(people, 0)
    label(people, 1, share=0.2)
    found = content(evaluate_project(people, Protocol.ORIENTED))["classes"]["person"]
    assert (found["objects"], found["detections"], found["matched"]) == (6, 6, 6), "unlabelled frames are not evaluated"
    assert found["mean_iou"] == pytest.approx((1 + 0.8 / 1.2) / 2)
    assert found["AP"] == pytest.approx({"0.25": 1.0, "0.5": 1.0, "0.7": 0.5})
    assert found["rotation_error_rad"] == pytest.approx(0.0, abs=1e-6)
    as_rooms = content(evaluate_project(people, Protocol.SUNRGBD))
    assert evaluate_project(people, Protocol.SUNRGBD).notes == ()
    assert as_rooms["0.5"] == {"mAP": pytest.approx(1.0), "AP": {"person": pytest.approx(1.0)}}


def test_original_proposals_are_evaluated_against_reviewed_labels(people: Project) -> None:
    """Frame 0 is reviewed with corrected boxes, frame 1 is not reviewed, and frame 2 has no proposals."""
    for index in (0, 1):
        propose(people, index, share=0.2)
    stored = people.frames.of()[0]
    for box in people.labels.of_frame(stored.id):
        context = WriteContext(people.frames.get(stored.id).revision, "me")
        people.labels.edit(stored.id, box.uid, context, label=box.label, box=moved(box.box, -0.2))
    label(people, 2)
    choice = Options(measured=Measured.PROPOSALS, against=Against.REVIEWED)
    found = content(evaluate_project(people, Protocol.ORIENTED, choice))["classes"]["person"]
    assert (found["objects"], found["detections"]) == (3, 3)
    assert found["mean_iou"] == pytest.approx(0.8 / 1.2)
    against_truth = evaluate_project(people, Protocol.ORIENTED, Options(measured=Measured.PROPOSALS))
    assert content(against_truth)["classes"]["person"]["objects"] == 6


def test_evaluation_can_be_limited_to_recordings_and_frames(
    make_project: Callable[..., Project], generated: Path
) -> None:
    project = make_project(generated / "people", generated / "hands", classes=("person", "hand"))
    ids = {recording.name: recording.id for recording in project.recordings.all()}
    for recording_id in ids.values():
        import_own_labels(project, recording_id)
    every = content(evaluate_project(project, Protocol.ORIENTED))
    assert sorted(every["classes"]) == ["hand", "person"]
    assert every["mAP"] == pytest.approx({"0.25": 1.0, "0.5": 1.0, "0.7": 1.0})
    hands = evaluate_project(project, Protocol.ORIENTED, Options(recordings=(ids["hands"],)))
    assert list(content(hands)["classes"]) == ["hand"]
    assert [note.split("; ")[0].split(": ")[1] for note in hands.notes] == ["10 of 10 labels"]
    one = evaluate_project(project, Protocol.ORIENTED, Options(frames=["people/000002"]))
    assert content(one)["classes"]["person"]["objects"] == 3


def test_invalid_comparisons_are_errors(people: Project, own_copy, make_project: Callable[..., Project]) -> None:
    with pytest.raises(ConfigError, match="no true boxes in the 0 frames"):
        evaluate_project(people, Protocol.ORIENTED)
    with pytest.raises(ConfigError, match="measure proposals"):
        evaluate_project(people, Protocol.ORIENTED, Options(against=Against.REVIEWED))
    label(people, 0)
    with pytest.raises(ConfigError, match="of a class that KITTI evaluates"):
        evaluate_project(people, Protocol.KITTI)
    with pytest.raises(ConfigError, match=r"has no frame people/7 \(unknown: 1 of 2 names\)"):
        evaluate_project(people, Protocol.ORIENTED, Options(frames=["people/7", "people/000001"]))
    folder = own_copy("people")
    (folder / "truth" / "boxes.json").unlink(missing_ok=True)
    (folder / "boxes.json").unlink(missing_ok=True)
    bare = make_project(folder)
    with pytest.raises(ConfigError, match="no true boxes beside any recording; measure against reviewed labels"):
        evaluate_project(bare, Protocol.ORIENTED)
    with pytest.raises(ConfigError, match="no true boxes beside people"):
        evaluate_project(bare, Protocol.ORIENTED, Options(recordings=(1,)))


def test_the_kitti_protocol_works_for_other_recordings(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path]
) -> None:
    """The 2D boxes are computed with the recording's camera."""
    folder = own_copy("people")
    for file in folder.rglob("boxes.json"):
        file.write_text(file.read_text().replace('"person"', '"Pedestrian"'))
    project = make_project(folder, classes=("Pedestrian",))
    import_own_labels(project, 1)
    found = content(evaluate_project(project, Protocol.KITTI))["Pedestrian"]
    assert list(found) == ["bbox", "aos", "bev", "3d"]
    # each of up to 15 counted objects gives one recall sample; R40 leaves out sample 0
    assert found["3d"]["R40"][1] == pytest.approx(100 * 14 / 40, abs=7.6)


def test_rcv_datasets_are_compared_frame_by_frame(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path
) -> None:
    other = make_project(generated / "people")
    for index in range(3):
        label(people, index)
        label(other, index + 1, share=0.2)
    for project, name in ((people, "truth"), (other, "found")):
        export_project(project, tmp_path / name, choose=ExportFilter())
    found = content(evaluate_files(tmp_path / "found", tmp_path / "truth", Protocol.ORIENTED))["classes"]["person"]
    # frames 0 to 2 are true, 1 to 3 detected
    assert (found["objects"], found["detections"], found["matched"]) == (9, 9, 6)
    assert found["mean_iou"] == pytest.approx(6 / 9 * 0.8 / 1.2)
    chosen = Options(frames=["people/000001"])
    one = evaluate_files(tmp_path / "found", tmp_path / "truth", Protocol.ORIENTED, chosen)
    assert content(one)["classes"]["person"]["objects"] == 3


def test_relaxed_overlaps_match_more_boxes(tmp_path: Path) -> None:
    found, truth = kitti_folders(tmp_path)
    for file in found.iterdir():
        file.write_text(file.read_text().replace(" 1.60 20.00", " 1.60 20.35"))
    strict, loose = (
        content(evaluate_files(found, truth, Protocol.KITTI, Options(relaxed=relaxed)))["Car"]
        for relaxed in (False, True)
    )
    assert strict["3d"]["R40"] == [0.0] * 3
    assert loose["3d"]["R40"] == pytest.approx([12.5] * 3)
    assert strict["bbox"] == loose["bbox"]
