"""COCO and YOLO datasets of a project: selection, splits, and import into another project."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from store_samples import by_machine, proposal_at

from annotator.formats.coco import read_coco
from annotator.formats.dataset_writing import Lost
from annotator.geometry.outline import box_on_image
from annotator.project import NewLabel, Project, RunShare, WriteContext
from annotator.project.boxes import Boxes
from annotator.project.records import ViewGeometry
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, OrientedBox, ReviewState, Source
from annotator.types.errors import ConfigError, FormatError, StaleRevisionError
from annotator.workflows.exporting import (
    ExportFilter,
    ExportFormat,
    ExportOptions,
    ExportReport,
    Split,
    SplitBy,
    export_project,
)
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing import FlatFormat, Note, format_of, import_image_boxes, import_view_boxes
from annotator.workflows.recorded.reading import load_truth

FORMATS = (ExportFormat.COCO, ExportFormat.YOLO)
DRAWN = (Box2D("person", 10.25, 20.5, 60.75, 90.0), Box2D("person", 100.0, -9.0, 160.5, 300.0))
# clipped to the image, which is 320 x 240
KEPT = (DRAWN[0], replace(DRAWN[1], y_min=-0.5, y_max=239.5))
ON_VIEW = Box2D("person", 3.5, 4.5, 30.25, 41.0)
BOTH = ExportOptions(pictures="both")


def picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (48, 64, 3), dtype=np.uint8)


def labelled(project: Project) -> list[int]:
    """Five frames: 0 with boxes, 1 labelled as empty, 2 with two reviewed labels, 3 half reviewed, 4 unlabelled.

    Frame 0 also has a pseudo-view with a box and one labelled as empty; a third view belongs to no frame.
    """
    ids = [frame.id for frame in project.frames.of()]
    project.boxes.set_on_image(ids[0], DRAWN, BoxKind.SILHOUETTE, WriteContext(0, "me"))
    project.boxes.set_on_image(ids[1], (), BoxKind.SILHOUETTE, WriteContext(0, "me"))
    recording = open_recording(project.recordings.all()[0].path)
    for index in (2, 3):
        truths = load_truth(recording, index, recording.frame(index))
        new = [NewLabel(t.label, t.box, track_id=7 + n) for n, t in enumerate(truths)]
        made = project.labels.create(ids[index], new, WriteContext(0, "me", Source.IMPORTED))
        project.labels.reject(ids[index], made.uids[1], WriteContext(made.receipt.revision, "me"))
    propose(project, ids[3])
    geometry = ViewGeometry.model_validate(
        {"axes": np.eye(3).tolist(), "metres_per_px": 0.01, "origin_m": [0.5, 0.25], "image_box": DRAWN[0]}
    )
    for seed, boxes in ((1, (ON_VIEW,)), (2, ())):
        project.boxes.set_on_view(
            project.views.store(picture(seed)),
            boxes,
            BoxKind.SILHOUETTE,
            WriteContext(project.frames.get(ids[0]).revision, "me"),
            frame_id=ids[0],
            step=1,
            geometry=geometry,
        )
    project.boxes.set_on_view(project.views.store(picture(3)), (ON_VIEW,), BoxKind.SILHOUETTE, WriteContext(0, "me"))
    return ids


def propose(project: Project, frame_id: int) -> None:
    """Adds an unreviewed proposal to the frame."""
    run = project.jobs.start(image_detector="i", view_detector="v", config_json="{}")
    context = by_machine(project.frames.get(frame_id).revision)
    project.proposals.replace(frame_id, [proposal_at(label="person")], context, run=RunShare(run.id, 1.0))


def exported(project: Project, out: Path, format: ExportFormat, **options: object) -> ExportReport:
    return export_project(project, out, format, **options)  # type: ignore[arg-type]


def assert_same(boxes: tuple[Box2D, ...], wanted: tuple[Box2D, ...]) -> None:
    assert [box.label for box in boxes] == [box.label for box in wanted]
    for box, want in zip(boxes, wanted, strict=True):
        assert box.xyxy == pytest.approx(want.xyxy, abs=1e-4)


@pytest.mark.parametrize("format", FORMATS)
def test_exported_pictures_can_be_imported_into_another_project(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path, format: ExportFormat
) -> None:
    ids = labelled(people)
    report = exported(people, tmp_path / "out", format, options=BOTH)
    assert format_of(tmp_path / "out") == format
    assert (report.frames, report.objects_by_class, report.splits) == (6, {"person": 2 + 2 + 1 + 1}, {})
    lost = {loss.kind: loss.count for loss in report.losses}
    solid = sum(label.state is not ReviewState.REJECTED for label in people.labels.of_frame(ids[2]))
    assert lost[Lost.SOLID] == lost[Lost.TRACK] == solid == 2
    assert lost[Lost.OPEN] == 1 and Lost.KIND not in lost

    other = make_project(generated / "people")
    done = import_image_boxes(other, tmp_path / "out", None, format=FlatFormat(format))
    assert (done.frames, done.boxes.total(), done.views, tuple(done.of(Note.UNMATCHED_IMAGE))) == (3, 6, 3, ())
    on_images = {boxes.frame_id: boxes for boxes in other.boxes.on_images()}
    kinds = [BoxKind.SILHOUETTE, BoxKind.SILHOUETTE, BoxKind.BOX]
    assert [boxes.box_kind for boxes in on_images.values()] == kinds
    assert list(on_images) == [other.frames.of()[index].id for index in (0, 1, 2)]
    drawn, empty, projected = (boxes.boxes for boxes in on_images.values())
    assert_same(drawn, KEPT)
    assert drawn[0] == DRAWN[0], "the image box of a view is imported without rounding"
    assert empty == ()
    frame = FrameSource(people).read(people.frames.of()[2])
    labels = [label for label in people.labels.of_frame(ids[2]) if label.state is not ReviewState.REJECTED]
    outlines = tuple(box_on_image(frame.camera, label.box, label.label) for label in labels)
    assert_same(projected, outlines)  # type: ignore[arg-type]
    before, after = (sorted(p.boxes.on_views(), key=lambda view: view.view_id) for p in (people, other))
    key = {each.id: each.key for project in (people, other) for each in project.frames.of()}
    for one, two in zip(before, after, strict=True):
        assert (one.view_id, one.step, one.geometry) == (two.view_id, two.step, two.geometry)
        assert (one.frame_id and key[one.frame_id]) == (two.frame_id and key[two.frame_id])
        assert_same(two.boxes, one.boxes)
        assert two.box_kind is one.box_kind


def test_a_copy_of_a_view_without_a_frame_is_not_exported_again(people: Project, tmp_path: Path) -> None:
    """Otherwise the same picture could be in both train and val."""
    labelled(people)
    people.boxes.set_on_view(people.views.store(picture(1)), (ON_VIEW,), BoxKind.SILHOUETTE, WriteContext(0, "me"))
    assert len([view for view in people.boxes.on_views() if view.frame_id is None]) == 2
    report = exported(people, tmp_path / "out", ExportFormat.COCO, options=ExportOptions(pictures="views"))
    assert report.frames == 3
    assert {loss.kind: loss.count for loss in report.losses} == {Lost.SAME: 1}


def test_a_thin_outline_is_exported_like_a_thin_drawn_box(people: Project, tmp_path: Path) -> None:
    frame = FrameSource(people).read(people.frames.of()[4])
    solid = np.array([0.5, 1.5 / frame.camera.fx * 3.0, 1e-3])
    # axes of the camera: x to the right is the width in pixels
    axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    box = OrientedBox.from_parts(np.array([0.0, 0.0, 3.0]), axes, solid)
    people.labels.create(people.frames.of()[4].id, [NewLabel("person", box)], WriteContext(0, "me"))
    report = exported(people, tmp_path / "out", ExportFormat.YOLO)
    assert report.objects == 1 and {loss.kind for loss in report.losses} == {Lost.SOLID}


def test_half_reviewed_frames_give_a_note_in_ground_truth_formats(people: Project, tmp_path: Path) -> None:
    labelled(people)
    report = exported(people, tmp_path / "kitti", ExportFormat.KITTI)
    (note,) = report.notes
    assert report.frames == 2 and note.startswith("left out: 1 unreviewed proposal on 1 of these frames")
    assert exported(people, tmp_path / "openlabel", ExportFormat.OPENLABEL).notes == ()
    with pytest.raises(ConfigError, match=r"called train, val, test, not (trainval|testing)"):
        exported(people, tmp_path / "bad", ExportFormat.KITTI, split=Split({"trainval": 0.5, "testing": 0.5}))
    assert not (tmp_path / "bad").exists()


def test_coco_and_yolo_have_the_same_splits(people: Project, tmp_path: Path) -> None:
    labelled(people)
    split = Split({"train": 0.6, "val": 0.4}, SplitBy.FRAMES, 1)
    coco = exported(people, tmp_path / "coco", ExportFormat.COCO, split=split, options=BOTH)
    yolo = exported(people, tmp_path / "yolo", ExportFormat.YOLO, split=split, options=BOTH)
    assert coco.splits == yolo.splits and sum(coco.splits.values()) == 6 and set(coco.splits) == {"train", "val"}
    for part, number in coco.splits.items():
        images = read_coco(tmp_path / f"coco/annotations/instances_{part}.json")
        assert len(images) == number
        for image in images:
            for file in (tmp_path / "coco" / part, tmp_path / "yolo/images" / part):
                shown = cv2.imread(str(file / image.file_name))
                assert shown.shape[1::-1] == image.size_px
    # an image and its views are in the same split
    rows = (tmp_path / "coco/frames.csv").read_text().splitlines()
    part_of = dict(row.split(",")[2::1] for row in rows[1:])
    for part in coco.splits:
        sidecar = tmp_path / "coco" / part / "views.json"
        for place in json.loads(sidecar.read_text()) if sidecar.exists() else []:
            assert place["frame"] is None or part_of[place["frame"]] == part
    with pytest.raises(FormatError, match="is not empty"):
        exported(people, tmp_path / "coco", ExportFormat.YOLO, overwrite=True)
    report = exported(people, tmp_path / "coco", ExportFormat.COCO, overwrite=True, options=BOTH)
    assert report.frames == 6 and len(list((tmp_path / "coco/all").glob("*.png"))) == 6
    with pytest.raises(ConfigError, match=r"train, val and \(optionally\) test"):
        exported(people, tmp_path / "bad", ExportFormat.YOLO, split=Split({"train": 0.5, "dev": 0.5}))
    assert not (tmp_path / "bad").exists()


def test_the_exported_pictures_depend_on_the_options(people: Project, tmp_path: Path) -> None:
    ids = labelled(people)
    coco = ExportFormat.COCO

    def stems(name: str, **options: object) -> list[str]:
        exported(people, tmp_path / name, coco, **options)
        (file,) = (tmp_path / name / "annotations").iterdir()
        return [image.file_name for image in read_coco(file)]

    assert stems("images") == [f"people-00000{number}.png" for number in (0, 1, 2)]
    views = stems("views", options=ExportOptions(pictures="views"))
    assert views[:2] == ["people-000000-view.png", "people-000000-view-2.png"] and views[2].startswith("view-")
    people.frames.finalise(ids[4], WriteContext(0, "me"))
    assert stems("more", options=ExportOptions("jpg")) == [f"people-00000{number}.jpg" for number in (0, 1, 2, 4)]
    proposed = ExportFilter(states=(ReviewState.PROPOSED, ReviewState.ACCEPTED))
    assert len(stems("proposed", choose=proposed)) == 5
    people.configure(classes=["person", "dog"])
    with pytest.raises(ConfigError, match="has no class 'cat'"):
        stems("cat", choose=ExportFilter(classes=("cat",)))
    # for another class, only the pictures labelled as empty are exported
    assert stems("dogs", choose=ExportFilter(classes=("dog",))) == ["people-000001.png", "people-000004.png"]
    # frame 2 has accepted boxes, so it is not empty for any selection of states
    people.frames.finalise(ids[2], WriteContext(people.frames.get(ids[2]).revision, "me"))
    edited = ExportFilter(states=(ReviewState.EDITED,))
    assert stems("edited", choose=edited) == [f"people-00000{number}.png" for number in (0, 1, 4)]


def yolo_of(folder: Path, **rows: str) -> Path:
    """A folder of label files: `yolo_of(path, K000001="0 0.5 0.5 0.25 0.5")`."""
    folder.mkdir()
    (folder / "classes.txt").write_text("person\n")
    for name, text in rows.items():
        (folder / f"{name.removeprefix('K')}.txt").write_text(text)
    return folder


def test_yolo_labels_of_other_tools_are_matched_by_file_stem(people: Project, tmp_path: Path) -> None:
    folder = yolo_of(tmp_path / "labels", K000001="0 0.5 0.5 0.25 0.5\n", K000003="", K9="0 0.5 0.5 1 1")
    done = import_image_boxes(people, folder, BoxKind.SILHOUETTE, format=FlatFormat.YOLO)
    assert (done.frames, done.boxes.total(), tuple(done.of(Note.UNMATCHED_IMAGE))) == (2, 1, ("9.txt",))
    one, two = people.boxes.on_images()
    assert one.boxes == (Box2D("person", 119.5, 59.5, 199.5, 179.5),) and two.boxes == ()


def test_yolo_boxes_are_valid_for_scaled_but_not_for_cropped_copies(people: Project, tmp_path: Path) -> None:
    """A scaled copy has the same relative coordinates; a cropped or padded copy does not."""
    folder = yolo_of(tmp_path / "labels", K000001="0 0.5 0.5 0.25 0.5\n")
    cv2.imwrite(str(folder / "000001.png"), np.zeros((120, 160, 3), np.uint8))
    assert import_image_boxes(people, folder, BoxKind.SILHOUETTE, format=FlatFormat.YOLO).boxes.total() == 1
    cv2.imwrite(str(folder / "000001.png"), np.zeros((160, 160, 3), np.uint8))
    with pytest.raises(FormatError, match="frame is 320 x 240: another aspect ratio"):
        import_image_boxes(people, folder, BoxKind.SILHOUETTE, format=FlatFormat.YOLO)


def test_yolo_boxes_on_views_are_imported(people: Project, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = yolo_of(tmp_path / "labels", front="0 0.5 0.5 0.25 0.5\n")
    (tmp_path / "pictures").mkdir()
    cv2.imwrite(str(tmp_path / "pictures/front.png"), picture(5))
    done = import_view_boxes(people, folder, tmp_path / "pictures", BoxKind.SILHOUETTE, FlatFormat.YOLO)
    assert (done.frames, done.boxes.total(), done.views) == (0, 1, 1)
    (view,) = people.boxes.on_views()
    assert view.boxes == (Box2D("person", 23.5, 11.5, 39.5, 35.5),) and view.frame_id is None
    # another import stores boxes on it in the meantime
    monkeypatch.setattr(Boxes, "on_views", lambda self: ())
    with pytest.raises(StaleRevisionError):
        import_view_boxes(people, folder, tmp_path / "pictures", BoxKind.SILHOUETTE, FlatFormat.YOLO)


def test_views_are_exported_without_the_images_of_unreadable_frames(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    recording = own_copy("people")
    project = make_project(recording)
    labelled(project)
    for file in (recording / "depth").iterdir():
        file.write_bytes(b"")
    choose = ExportFilter(skip_unreadable=True)
    report = exported(project, tmp_path / "out", ExportFormat.COCO, options=BOTH, choose=choose)
    assert (report.frames, len(report.unreadable)) == (3, 3)


def test_yolo_boxes_of_unreadable_frames_are_skipped_and_reported(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], tmp_path: Path
) -> None:
    recording = own_copy("people")
    project = make_project(recording)
    (recording / "depth" / "000001.png").write_bytes(b"")
    folder = yolo_of(tmp_path / "labels", K000000="0 0.5 0.5 0.25 0.5", K000001="0 0.5 0.5 0.25 0.5")
    done = import_image_boxes(project, folder, BoxKind.SILHOUETTE, format=FlatFormat.YOLO)
    assert (
        done.frames == 1
        and len(list(done.of(Note.UNREADABLE))) == 1
        and next(iter(done.of(Note.UNREADABLE))).startswith("000001: ")
    )
