"""Attributes of boxes, tracks and frames: their schema, their values, and what changes of the classes do to them."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError
from store_samples import box_at, by_hand, by_machine, give_attributes, proposal_at, revised, some_boxes

from annotator.project import NewLabel, Project, StoredRecording
from annotator.project.changes import LabelChanged
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.types import Box2D, BoxKind, ReviewState
from annotator.types.errors import ConfigError, HistoryError, NotFoundError, ProjectError, StaleRevisionError


@pytest.fixture(autouse=True)
def _schema(project: Project) -> None:
    give_attributes(project)


def create(project: Project, frame: int, label: str = "hand", **values: Any) -> str:
    revision = project.frames.get(frame).revision
    return project.labels.create(frame, [NewLabel(label, box_at(revision), **values)], by_hand(revision)).uids[0]


def of(project: Project, uid: str) -> dict[str, Any]:
    return dict(project.labels.get(uid).label.attributes)


def revision(project: Project, frame: int) -> int:
    return project.frames.get(frame).revision


def named(project: Project, uid: str) -> str:
    return project.labels.get(uid).label.label


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"kind": "choice"}, "needs at least one"),
        ({"kind": "text", "minimum": 1}, "are for the kinds integer and number"),
        ({"kind": "number", "minimum": 2, "maximum": 1}, "minimum is greater"),
        ({"kind": "integer", "default": "two"}, "must be a whole number"),
        ({"kind": "choice", "choices": ["a", "a"]}, "must differ"),
        ({"kind": "boolean", "of": "frame", "classes": ["hand"]}, "no classes"),
        ({"kind": "text", "key": "ctrl"}, "'ctrl' is not a key"),
        ({"kind": "text", "name": "a b"}, "'a b' is not a name"),
    ],
)
def test_an_attribute_that_contradicts_itself_is_refused(changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem):
        Attribute.model_validate({"name": "new"} | changes)


@pytest.mark.parametrize(
    ("kind", "given", "read"),
    [
        ("integer", "2", 2),
        ("number", "0.5", 0.5),
        ("number", 1, 1.0),
        ("boolean", "Yes", True),
        ("boolean", 0, False),
        ("text", 7, "7"),
        ("integer", 2.5, None),
        ("integer", True, None),
        ("number", float("nan"), None),
        ("number", 10**400, None),
        ("boolean", "maybe", None),
    ],
)
def test_values_of_files_are_read_where_they_can_be(kind: str, given: Any, read: Any) -> None:
    attribute = Attribute(name="new", kind=AttributeKind(kind))
    if read is None:
        with pytest.raises(ValueError, match="new must be"):
            attribute.read(given)
    else:
        assert (attribute.read(given), type(attribute.read(given))) == (read, type(read))


def test_new_labels_get_defaults_and_values_of_their_track(project: Project, recording: StoredRecording) -> None:
    first, second = (frame.id for frame in project.frames.of([recording.id])[:2])
    uid = create(project, first, track_id=7, attributes={"side": "left"})
    assert of(project, uid) == {"severity": 0, "side": "left"}
    assert of(project, create(project, second, track_id=7)) == {"severity": 0, "side": "left"}
    assert of(project, create(project, second, track_id=8, attributes={"severity": 3})) == {"severity": 3}
    assert project.proposals.replace(first, [proposal_at(9.0)], by_machine(1), track_ids=[8]).uids[0] is not None
    (proposed,) = [label for label in project.labels.of_frame(first) if label.uid != uid]
    assert proposed.attributes == {"severity": 0}


@pytest.mark.parametrize(
    ("values", "problem"),
    [
        ({"severity": 4}, "severity must be a whole number from 0 to 3, not 4"),
        ({"pose": "sitting"}, "hand has no attribute 'pose' (it has: severity, side)"),
    ],
)
def test_values_that_the_schema_lacks_are_refused(
    project: Project, frame: int, values: dict[str, Any], problem: str
) -> None:
    uid = create(project, frame)
    for change in (
        lambda: create(project, frame, attributes=values),
        lambda: project.labels.set_attributes(frame, uid, values, revised(project, frame)),
    ):
        with pytest.raises(ProjectError, match=problem.replace("(", r"\(").replace(")", r"\)")):
            change()
    # what is carried along is no mistake of the operator
    carried = NewLabel("hand", box_at(4.0), state=ReviewState.PROPOSED, attributes=values, uid="carried")
    project.log.append(frame, [carried], revised(project, frame))
    assert of(project, "carried") == {"severity": 0}


def test_values_of_a_track_are_set_in_its_labels_whose_class_has_them_as_one_action(
    project: Project, recording: StoredRecording
) -> None:
    helmet = Attribute(name="helmet", kind=AttributeKind.BOOLEAN, of=AttributeOf.TRACK, classes=("person",))
    project.change_classes(edit.PutAttribute(attribute=helmet), "ann")
    ids = [frame.id for frame in project.frames.of([recording.id])[:3]]
    uids = [create(project, id, label, track_id=7) for id, label in zip(ids, ("hand", "person", "hand"), strict=True)]
    other = create(project, ids[2], track_id=8)
    values = {"side": "left", "severity": 2, "helmet": True}
    project.labels.set_attributes(ids[1], uids[1], values, revised(project, ids[1]))
    unchanged = {"severity": 0}
    assert [of(project, uid) for uid in (*uids, other)] == [
        unchanged | {"side": "left"},
        values,
        unchanged | {"side": "left"},
        unchanged,
    ]
    assert project.history.next("ann")[0] == "set attributes of 3 labels (frames 2 to 3)"
    # a label that enters the track takes its values, one that leaves it keeps them
    project.log.append(ids[2], [LabelChanged(uid=uids[2], track_id=9)], revised(project, ids[2]))
    project.labels.edit(ids[2], other, revised(project, ids[2]), label="hand", box=box_at(1.0), track_id=7)
    assert (of(project, uids[2])["side"], of(project, other)["side"]) == ("left", "left")
    with pytest.raises(StaleRevisionError):
        project.labels.set_attributes(ids[1], uids[1], {"side": None}, by_hand(1))
    with pytest.raises(ProjectError, match="helmet"):
        project.labels.set_attributes(ids[2], other, {"helmet": True}, revised(project, ids[2]))


def test_a_class_change_takes_away_what_the_new_class_lacks_and_undo_brings_it_back(
    project: Project, frame: int
) -> None:
    uid = create(project, frame, "person", attributes={"pose": "lying", "severity": 2})
    project.labels.edit(frame, uid, revised(project, frame), label="hand", box=box_at(1.0))
    assert of(project, uid) == {"severity": 2}
    project.history.undo("ann")
    assert of(project, uid) == {"severity": 2, "pose": "lying"}


def test_values_of_frames_are_set(project: Project, frame: int) -> None:
    project.frames.set_attributes(frame, {"weather": 1}, by_hand())
    assert project.frames.attributes() == {frame: {"weather": 1.0}}
    with pytest.raises(ProjectError, match="a frame has no attribute 'severity'"):
        project.frames.set_attributes(frame, {"severity": 1}, revised(project, frame))


def test_a_renamed_class_keeps_all_that_is_stored(project: Project, frame: int) -> None:
    project.change_classes(edit.StyleClass(name="hand", style={"key": "h"}), "ann")
    uid = create(project, frame, attributes={"side": "left"})
    project.boxes.set_on_image(frame, some_boxes(2), BoxKind.BOX, revised(project, frame))
    before = project.frames.get(frame).revision
    config = project.change_classes(edit.RenameClass(name="hand", new="palm"), "bea")
    assert (config.classes, config.class_styles["palm"].key) == (("palm", "person"), "h")
    assert named(project, uid) == "palm"
    assert of(project, uid) == {"severity": 0, "side": "left"}
    boxes = project.boxes.on_image(frame)
    assert boxes is not None and [box.label for box in boxes.boxes] == ["palm", "palm"]
    with pytest.raises(StaleRevisionError):
        project.labels.accept(frame, uid, by_hand(before))
    # earlier actions can still be undone, under the new name
    assert project.history.undo("ann").words.startswith("draw on the image")
    assert project.history.undo("ann").words == "draw palm (frame 3)"


def test_a_merge_is_undone_and_what_was_drawn_since_keeps_its_class(project: Project, frame: int) -> None:
    uid = create(project, frame, "person", attributes={"pose": "lying"})
    project.change_classes(edit.MergeClasses(names=["person"], into="hand"), "ann")
    assert project.config.classes == ("hand",)
    # the attribute followed, too
    assert (named(project, uid), of(project, uid)["pose"]) == ("hand", "lying")
    project.change_classes(edit.RenameClass(name="hand", new="palm"), "bea")
    with pytest.raises(HistoryError, match=r"merge person into the class hand: .* the class palm was changed by bea"):
        project.history.undo("ann")
    project.history.undo("bea")
    (new,) = project.labels.create(
        frame, [NewLabel("hand", box_at(5.0))], by_hand(revision(project, frame), "bea")
    ).uids
    assert project.history.undo("ann").words == "merge person into the class hand"
    assert (project.config.classes, named(project, uid), named(project, new)) == (("hand", "person"), "person", "hand")
    with pytest.raises(NotFoundError, match="no class 'car'"):
        project.change_classes(edit.MergeClasses(names=["car"], into="person"), "ann")


def test_a_removed_class_comes_back_with_its_boxes(project: Project, frame: int) -> None:
    kept, removed = create(project, frame, "hand"), create(project, frame, "person")
    project.boxes.set_on_image(frame, some_boxes(1), BoxKind.BOX, revised(project, frame))
    with pytest.raises(ConfigError, match="only person has the attribute pose"):
        project.configure(classes=["hand"])
    project.change_classes(edit.RemoveAttribute(name="pose"), "bea")
    with pytest.raises(ProjectError, match="'person' cannot be removed while boxes use it"):
        project.configure(classes=["hand"])
    assert {each.uid for each in project.labels.of_frame(frame)} == {kept, removed}
    project.change_classes(edit.RemoveClass(name="person", with_boxes=True), "bea")
    assert [each.uid for each in project.labels.of_frame(frame)] == [kept]
    project.history.undo("ann")
    with pytest.raises(HistoryError, match="the person label was changed by bea since"):
        project.history.undo("ann")
    before = project.frames.get(frame).revision
    assert [project.history.undo("bea").words for _ in range(2)] == [
        "remove the class person",
        "remove the attribute pose",
    ]
    assert {each.uid for each in project.labels.of_frame(frame)} == {kept, removed}
    assert project.config.attributes[1].classes == ("person",)
    with pytest.raises(StaleRevisionError):
        project.labels.accept(frame, removed, by_hand(before))
    assert project.history.undo("ann").words == "draw person (frame 3)"


def test_what_others_use_is_not_undone(project: Project, frame: int) -> None:
    project.change_classes(edit.AddClass(name="car"), "ann")
    project.labels.create(frame, [NewLabel("car", box_at())], by_hand(0, "bea"))
    with pytest.raises(HistoryError, match="add the class car: cannot be undone because 'car' cannot be removed"):
        project.history.undo("ann")
    project.history.undo("bea")
    assert project.history.undo("ann").frame_id is None
    with pytest.raises(HistoryError, match="the class 'car' was removed"):
        project.history.redo("bea")
    grip = Attribute(name="grip", kind=AttributeKind.INTEGER)
    project.change_classes(edit.PutAttribute(attribute=grip), "ann")
    new = NewLabel("hand", box_at(), attributes={"grip": 1})
    project.labels.create(frame, [new], by_hand(revision(project, frame), "bea"))
    with pytest.raises(HistoryError, match=r"add the attribute grip: .* 1 stored value of grip would not fit"):
        project.history.undo("ann")


def test_attributes_are_renamed_narrowed_and_removed(project: Project, frame: int) -> None:
    uid = create(project, frame, "person", attributes={"pose": "lying", "severity": 3})
    project.change_classes(edit.RenameAttribute(name="pose", choice="lying", new="prone"), "ann")
    project.change_classes(edit.RenameAttribute(name="pose", new="posture"), "ann")
    assert of(project, uid) == {"posture": "prone", "severity": 3}
    narrow = Attribute(name="severity", kind=AttributeKind.INTEGER, minimum=0.0, maximum=2.0)
    with pytest.raises(ProjectError, match="1 stored value of severity would not fit, such as 3"):
        project.change_classes(edit.PutAttribute(attribute=narrow), "ann")
    assert of(project, uid)["severity"] == 3
    project.change_classes(edit.PutAttribute(attribute=narrow, drop=True), "ann")
    assert of(project, uid) == {"posture": "prone"}
    for values in ({"posture": "prone", "severity": 3}, {"pose": "prone", "severity": 3}):
        project.history.undo("ann")
        assert of(project, uid) == values
    for _ in range(2):
        project.history.redo("ann")
    assert of(project, uid) == {"posture": "prone"}
    project.change_classes(edit.RemoveAttribute(name="posture"), "ann")
    assert of(project, uid) == {}
    default = narrow.model_copy(update={"name": "grip", "default": 1})
    project.change_classes(edit.PutAttribute(attribute=default), "ann")
    assert of(project, uid) == {"grip": 1}


def test_values_that_exports_measure_have_no_default(project: Project, frame: int) -> None:
    truncation = Attribute(name="truncation", kind=AttributeKind.NUMBER, minimum=0.0, maximum=1.0, default=0.0)
    with pytest.raises(ConfigError, match="exports measure it for boxes without a value"):
        project.change_classes(edit.PutAttribute(attribute=truncation), "ann")
    without = truncation.model_copy(update={"default": None})
    project.change_classes(edit.PutAttribute(attribute=without), "ann")
    assert of(project, create(project, frame)) == {"severity": 0}


def proposals(project: Project) -> list[tuple[str, float]]:
    open_ = project.labels.select(states=[ReviewState.PROPOSED])
    return sorted((each.label.uid, round(float(each.label.box.center_m[0]), 2)) for each in open_)


def test_a_pass_keeps_proposals_of_which_a_person_has_set_values(project: Project, frame: int) -> None:
    kept, other = project.proposals.replace(frame, [proposal_at(0.0), proposal_at(5.0)], by_machine()).uids
    assert kept is not None
    assert other is not None
    project.labels.set_attributes(frame, kept, {"severity": 2}, revised(project, frame))
    again = [proposal_at(0.05), proposal_at(5.05), proposal_at(9.0)]

    def second_pass() -> tuple[str | None, ...]:
        return project.proposals.replace(frame, again, by_machine(project.frames.get(frame).revision)).uids

    covered, *new = second_pass()
    assert covered is None
    assert proposals(project) == sorted([(kept, 0.0), (new[0], 5.05), (new[1], 9.0)])
    assert of(project, kept)["severity"] == 2
    # undone, it is a proposal like the others; redone, it is kept again
    project.history.undo("ann")
    project.history.redo("ann")
    assert second_pass()[0] is None
    project.history.undo("ann")
    assert second_pass()[0] is not None
    assert kept not in dict(proposals(project))


def test_imported_proposals_with_values_stay_too(project: Project, frame: int) -> None:
    project.proposals.bring("mine", {frame: [NewLabel("hand", box_at(0.0), 0.5), NewLabel("hand", box_at(5.0), 0.5)]})
    (kept, _), (other, _) = sorted(proposals(project), key=lambda each: each[1])
    project.labels.set_attributes(frame, kept, {"severity": 3}, revised(project, frame))
    revision = project.frames.get(frame).revision
    ours = project.proposals.replace(frame, [proposal_at(0.02), proposal_at(20.0)], by_machine(revision))
    assert ours.uids[0] is None
    assert (of(project, kept)["severity"], len(proposals(project))) == (3, 3)
    brought = project.proposals.bring("mine", {frame: [NewLabel("hand", box_at(0.1), 0.9)]})[frame]
    assert brought.is_open == (False,)
    assert (of(project, kept)["severity"], other in dict(proposals(project))) == (3, False)
    assert [each.source for each in project.labels.get(kept).said] == ["mine"]


def test_a_value_of_a_track_keeps_only_the_proposal_on_which_it_was_set(
    project: Project, recording: StoredRecording
) -> None:
    frames = [each.id for each in project.frames.of([recording.id])[:2]]
    uids = [
        project.proposals.replace(id, [proposal_at(0.0)], by_machine(), track_ids=[7]).uids[0] or "" for id in frames
    ]
    project.labels.set_attributes(frames[0], uids[0], {"side": "left"}, revised(project, frames[0]))
    assert [of(project, uid)["side"] for uid in uids] == ["left", "left"]
    assert [project.labels.kept(id) for id in frames] == [{uids[0]}, frozenset()]


def test_undo_brings_a_label_back_without_an_image_box_of_a_removed_class(project: Project, frame: int) -> None:
    drawn = NewLabel("person", box_at(), image_box=Box2D("hand", 0.0, 0.0, 9.0, 9.0))
    (uid,) = project.labels.create(frame, [drawn], by_hand()).uids
    project.labels.delete(frame, uid, by_hand(1))
    project.change_classes(edit.RemoveClass(name="hand", with_boxes=True), "bea")
    project.history.undo("ann")
    assert project.labels.get(uid).image_box is None
