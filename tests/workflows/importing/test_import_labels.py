"""3D boxes become labels of the matching frames, or an error changes nothing; values of 2D boxes; what is told."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from annotator.formats.coco import write_coco
from annotator.formats.frame_names import LabelledFrame, PictureLabels
from annotator.project import NewLabel, Project, WriteContext, new_action
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute
from annotator.types import Box2D, BoxKind, OrientedBox, ReviewState, Source, Truth
from annotator.types.errors import FormatError
from annotator.workflows.exporting import ExportFilter, ExportFormat, export_project
from annotator.workflows.importing import (
    BoxFormat,
    FlatFormat,
    Importer,
    Note,
    Preview,
    import_image_boxes,
    import_labels,
    import_proposals,
    preview_boxes,
    read_labels,
)
from annotator.workflows.importing.boxes_3d import create_if_unlabelled
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.placing import AUTHOR, OwnClasses
from annotator.workflows.recorded.own_labels import import_own_labels

BOX = OrientedBox.from_parts(np.array([0.1, 0.2, 3.0]), np.eye(3), np.array([0.5, 0.4, 1.8]))


def labels_of(boxes: dict[str, list[Truth]]) -> LabelSet:
    return LabelSet(Path("given"), {name: LabelledFrame(truths) for name, truths in boxes.items()})


@pytest.mark.parametrize("name", ["rcv", "openlabel"])
def test_boxes_around_what_is_seen_stay_such(
    people: Project, make_project: Callable[..., Project], generated: Path, tmp_path: Path, name: str
) -> None:
    new = [NewLabel("person", BOX, box_kind=kind) for kind in (BoxKind.SILHOUETTE, BoxKind.BOX)]
    people.labels.create(people.frames.of()[0].id, new, WriteContext(0, "me", Source.MANUAL))
    export_project(people, tmp_path / "out", ExportFormat(name))
    other = make_project(generated / "people")
    import_labels(other, read_labels(BoxFormat(name), tmp_path / "out"))
    imported = other.labels.of_frame(other.frames.of()[0].id)
    assert sorted(label.box_kind for label in imported) == [BoxKind.BOX, BoxKind.SILHOUETTE]


def test_labelled_frames_are_not_changed_and_other_classes_are_counted(people: Project) -> None:
    first, second = people.frames.of()[:2]
    people.labels.create(first.id, [NewLabel("person", BOX)], WriteContext(0, "me", Source.MANUAL))
    given = labels_of(
        {
            f"people/{first.key}": [Truth("person", BOX)],
            f"people/{second.key}": [Truth("person", BOX, 4), Truth("horse", BOX)],
            "people/gone": [],
        }
    )
    done = import_labels(people, given)
    assert (done.frames, done[Note.ALREADY], tuple(done.of(Note.UNMATCHED))) == (1, 1, ("people/gone",))
    assert (done.boxes, done.of(Note.OTHER_CLASS)) == ({"person": 1}, {"horse": 1})
    assert [label.author for label in people.labels.of_frame(first.id)] == ["me"]
    assert [label.track_id for label in people.labels.of_frame(second.id)] == [4]


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("Person", "person"),
        ("traffic light", "Traffic_Light"),
        ("car", "car"),
        ("CAR", None),
        ("Pedestrian", "person"),
        ("Cyclist", None),
        ("bus", None),
    ],
)
def test_a_class_of_the_same_name_in_another_spelling_is_the_same(theirs: str, ours: str | None) -> None:
    """Unless the project has two of them; the names that are given come first."""
    names = {"Pedestrian": "person", "bus": "", "Cyclist": "no class"}
    assert OwnClasses(("person", "Traffic_Light", "car", "Car", "bus"), names).of(theirs) == ours


def test_boxes_of_classes_that_were_left_out_are_imported_beside_the_others(people: Project) -> None:
    first = people.frames.of()[0]
    far = OrientedBox.from_parts(np.array([1.5, 0.2, 6.0]), np.eye(3), np.array([0.5, 0.4, 1.8]))
    given = labels_of({f"people/{first.key}": [Truth("Person", BOX), Truth("Rider", far)]})
    assert import_labels(people, given).of(Note.OTHER_CLASS) == {"Rider": 1}
    for _ in range(2):  # again: a label covers the box
        import_labels(people, given, names={"Rider": "person"}, beside=("Rider",))
        labels = people.labels.of_frame(first.id)
        assert [label.box.center_m.tolist() for label in labels] == [[0.1, 0.2, 3.0], [1.5, 0.2, 6.0]]


@pytest.mark.parametrize(
    ("written", "kept", "lost"),
    [
        ((0.25, 1.0, None), [0.25, 1.0, None], 0),
        # one score outside 0..1 shows that all are raw scores
        ((0.25, 7.5, None), [None, None, None], 2),
        ((-0.5, 0.0, None), [None, None, None], 2),
    ],
)
def test_scores_of_kitti_results_are_kept_only_if_they_are_confidences(
    people: Project, tmp_path: Path, written: tuple[float | None, ...], kept: list[float | None], lost: int
) -> None:
    files = [f"{stored.key}.txt" for stored in people.frames.of()[:2]]
    rows = [f"person 0 0 0 9 9 50 80 1.8 0.4 0.5 {x} 1 3 0" for x in range(3)]
    scored = [row if score is None else f"{row} {score}" for row, score in zip(rows, written, strict=True)]
    (tmp_path / files[0]).write_text(f"{scored[0]}\n")
    (tmp_path / files[1]).write_text("\n".join(scored[1:]))
    done = import_labels(people, read_labels(BoxFormat.KITTI, tmp_path))
    assert (done.boxes, done[Note.SCORE], done[Note.NOT_REVIEWED]) == ({"person": 3}, lost, 0)
    assert [x.score for stored in people.frames.of() for x in people.labels.of_frame(stored.id)] == kept


def test_finalised_frames_are_not_changed(people: Project) -> None:
    first, second = people.frames.of()[:2]
    people.frames.finalise(first.id, WriteContext(0, "me"))
    given = labels_of({f"people/{frame.key}": [Truth("person", BOX)] for frame in (first, second)})
    done = import_labels(people, given)
    assert (done.frames, done[Note.ALREADY]) == (1, 1) and people.labels.of_frame(first.id) == ()
    assert not create_if_unlabelled(people, first.id, [NewLabel("person", BOX)], AUTHOR)
    assert import_own_labels(people, 1).boxes == {"person": 9} and people.labels.of_frame(first.id) == ()


def test_a_key_of_several_recordings_needs_the_recording(make_project: Callable[..., Project], generated: Path) -> None:
    project = make_project(generated / "people", generated / "hands", classes=("person", "hand"))
    key = project.frames.of()[0].key
    given = labels_of({key: [Truth("hand", BOX)]})
    with pytest.raises(FormatError, match=r"is a frame of several recordings \(people, hands\)"):
        import_labels(project, given)
    assert import_labels(project, given, "hands").boxes == {"hand": 1}


def test_frames_of_unknown_recordings_are_unmatched(people: Project) -> None:
    """Other recordings may have the same keys. Only the single recording of a dataset is taken as renamed."""
    first, second = (frame.key for frame in people.frames.of()[:2])
    both = labels_of({f"people/{first}": [Truth("person", BOX)], f"street/{second}": [Truth("person", BOX)]})
    done = import_labels(people, both)
    assert (done.frames, tuple(done.of(Note.UNMATCHED)), done.of(Note.RENAMED)) == (1, (f"street/{second}",), {})
    with pytest.raises(FormatError, match="none of the dataset's frames"):
        import_labels(people, labels_of({f"street/{first}": [], f"yard/{second}": []}))
    done = import_labels(people, labels_of({f"other/{second}": [Truth("person", BOX)]}))
    assert (done.frames, done.of(Note.RENAMED)) == (1, {"other of the labels was assigned to people": 1})


@pytest.mark.parametrize(
    ("names", "problem"),
    [
        (["people/000001", "000001"], "people/000001 and 000001 both match frame 000001"),
        ([], "has no frames, so there is nothing to import"),
    ],
)
def test_unmatched_frames_are_errors_and_change_nothing(people: Project, names: list[str], problem: str) -> None:
    with pytest.raises(FormatError, match=problem):
        import_labels(people, labels_of({name: [Truth("person", BOX)] for name in names}))
    assert not any(people.labels.of_frame(frame.id) for frame in people.frames.of())


ENTRY: dict[str, Any] = {"size": [4.0, 1.6, 1.5], "rotation": np.eye(3).tolist(), "center": [0.0, 0.0, 9.0]}


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
        write_coco(tmp_path / "c.json", [PictureLabels(name, (box,), (320, 240)) for name in names])
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


SCHEMA: list[dict[str, Any]] = [
    {"name": "pose", "kind": "choice", "choices": ["sitting", "standing"]},
    {"name": "occluded", "kind": "boolean"},
    {"name": "night", "kind": "boolean", "of": "frame"},
]


@pytest.fixture
def project(make_project: Callable[..., Project], generated: Path) -> Project:
    """A project with two labels side by side; one has a value."""
    made = make_project(generated / "people")
    for fields in SCHEMA:
        made.change_classes(edit.PutAttribute(attribute=Attribute.model_validate(fields)), "ann")
    new = [NewLabel("person", box(-0.8), attributes={"pose": "sitting"}), NewLabel("person", box(0.8))]
    rejected = NewLabel("person", box(0.0), state=ReviewState.REJECTED)
    made.labels.create(made.frames.of()[0].id, [*new, rejected], WriteContext(0, "me"))
    return made


def box(x: float) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x, 0.2, 3.0]), np.eye(3), np.array([0.5, 0.4, 1.0]))


def changed(project: Project, out: Path, change: Callable[[list[dict[str, Any]]], None]) -> Path:
    """An export whose annotations another tool has changed."""
    export_project(project, out, ExportFormat.COCO, choose=ExportFilter())
    (file,) = (out / "annotations").iterdir()
    content = json.loads(file.read_text())
    change(content["annotations"])
    file.write_text(json.dumps(content))
    return out


def values(project: Project) -> list[dict[str, Any]]:
    return [dict(each.attributes) for each in project.labels.of_frame(project.frames.of()[0].id)]


def test_labels_get_the_values_that_they_lack_and_the_rest_is_reported(project: Project, tmp_path: Path) -> None:
    def change(annotations: list[dict[str, Any]]) -> None:
        # as CVAT writes them: its own fields beside the task's attributes
        annotations[0]["attributes"] = {"pose": "standing", "occluded": True, "rotation": 0.0}
        annotations[1]["attributes"] = {"pose": "lying", "occluded": "false", "note": None}
        alone = annotations[1] | {"id": 9, "bbox": [0, 0, 5, 5], "attributes": ["crowded.no"]}
        annotations.append(alone)

    out = changed(project, tmp_path / "out", change)
    done = import_image_boxes(project, out, None, importer=Importer("ann", new_action()))
    assert values(project) == [{"pose": "sitting", "occluded": True}, {"occluded": False}, {}]
    assert (done[Note.SHOWN], done[Note.CONTRADICTED], done.boxes.total()) == (2, 1, 3)
    assert done.of(Note.VALUE) == {
        "rotation (not an attribute of the project)": 1,
        'pose must be one of sitting, standing, not "lying"': 1,
        "crowded (of 2D boxes without a 3D label)": 1,
    }
    # one action with the boxes
    project.history.undo("ann")
    assert values(project) == [{"pose": "sitting"}, {}, {}]
    assert project.boxes.on_image(project.frames.of()[0].id) is None


def test_a_drawn_box_has_the_values_of_its_label(project: Project, tmp_path: Path) -> None:
    """A box drawn on the image replaces the outline of its label, not its values."""
    out = changed(project, tmp_path / "out", lambda annotations: annotations.pop())
    import_image_boxes(project, out, None)
    frame = project.frames.of()[0]
    project.frames.set_attributes(frame.id, {"night": True}, WriteContext(project.frames.get(frame.id).revision, "me"))
    report = export_project(project, tmp_path / "again", ExportFormat.COCO, choose=ExportFilter())
    assert "attribute" not in {each.kind.value for each in report.losses}
    (file,) = (tmp_path / "again" / "annotations").iterdir()
    content = json.loads(file.read_text())
    assert [each.get("attributes") for each in content["annotations"]] == [{"pose": "sitting"}, None]
    assert [each.get("attributes") for each in content["images"]] == [{"night": True}]
    # an image of a finalised frame changes nothing
    project.frames.finalise(frame.id, WriteContext(project.frames.get(frame.id).revision, "me"))
    assert import_image_boxes(project, tmp_path / "again", None)[Note.SHOWN] == 0
