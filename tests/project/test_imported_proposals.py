"""Proposals of other software: one for each object, beside ours, and who said what stays known."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform
from sqlalchemy import select
from store_samples import box_at, by_hand, by_machine, proposal_at, revised

from annotator.project import NewLabel, Project, ProjectConfig, StoredRecording, new_action
from annotator.project.audit.events import read_row
from annotator.project.backup.verify import verify
from annotator.project.changes import LabelChanged, TracksLinked
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.project.classes.counts import ClassCounts
from annotator.project.classes.edit import ClassEdit
from annotator.project.database.schema import labels
from annotator.project.labels import StoredLabel
from annotator.project.recordings import SharedCloud
from annotator.project.records import BoxRecord
from annotator.project.review import By, waiting, waiting_sources
from annotator.project.rows import said_json
from annotator.project.sources import Brought
from annotator.types import Box2D, Correction, ReviewState, Source
from annotator.types.errors import HistoryError, ProjectError


def bring(project: Project, frame: int, source: str, *boxes: NewLabel) -> tuple[int, int, int]:
    """Number of open, merged and covered boxes."""
    done = project.proposals.bring(source, {frame: boxes})[frame]
    return done.is_open.count(True), done.merged, done.is_open.count(False)


def put(project: Project, *attributes: Attribute) -> None:
    for each in attributes:
        project.change_classes(edit.PutAttribute(attribute=each), "ann")


def box(x: float, score: float | None = None, label: str = "hand", track_id: int | None = None) -> NewLabel:
    return NewLabel(label, box_at(x), score, track_id)


def shown(project: Project) -> list[tuple[str, float, list[str]]]:
    """Source, x and further sources of every open proposal."""
    return sorted(map(_shown, project.labels.select(states=[ReviewState.PROPOSED])))


def _shown(stored: StoredLabel) -> tuple[str, float, list[str]]:
    said = [each.source for each in stored.said]
    is_ours = stored.label.source is Source.AUTO
    source = "ours" if is_ours else said[0]
    return source, round(float(stored.label.box.center_m[0]), 3), said if is_ours else said[1:]


def test_a_source_replaces_what_it_said_before_and_nothing_else(project: Project, frame: int) -> None:
    assert bring(project, frame, "one", box(0.0), box(5.0, 0.3)) == (2, 0, 0)
    assert bring(project, frame, "two", box(10.0)) == (1, 0, 0)
    assert bring(project, frame, "one", box(20.0)) == (1, 0, 0)
    assert shown(project) == [("one", 20.0, []), ("two", 10.0, [])]
    assert bring(project, frame, "two") == (0, 0, 0)
    assert shown(project) == [("one", 20.0, [])]
    (stored,) = project.labels.select()
    assert (stored.label.source, stored.label.author) == (Source.IMPORTED, "one")


def test_one_object_is_one_proposal_and_the_surest_box_is_shown(project: Project, frame: int) -> None:
    said = {"a": box(0.0, 0.2), "b": box(0.02, 0.9, label="person"), "c": box(0.04, 0.5)}
    for source in said:
        bring(project, frame, source, said[source], box({"a": 10.0, "b": 20.0, "c": 30.0}[source], 0.5))
    assert shown(project) == [("a", 10.0, []), ("b", 0.02, ["c", "a"]), ("b", 20.0, []), ("c", 30.0, [])]
    # what the others said takes its place
    bring(project, frame, "b")
    assert shown(project) == [("a", 10.0, []), ("c", 0.04, ["a"]), ("c", 30.0, [])]


def test_two_boxes_of_one_source_stay_apart(project: Project, frame: int) -> None:
    bring(project, frame, "one", box(0.0, 0.9), box(0.01, 0.8))
    bring(project, frame, "two", box(0.0, 0.7))
    assert shown(project) == [("one", 0.0, ["two"]), ("one", 0.01, [])]


SOURCES = ("annotator", "one", "two")


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.sampled_from(SOURCES), st.sets(st.integers(0, 2))), min_size=2, max_size=8))
def test_what_is_shown_follows_from_what_each_source_has_said_last(
    project: Project, recording: StoredRecording, told: list[tuple[str, set[int]]]
) -> None:
    """In whatever order they spoke, ours among them; what a surer box has hidden is as before when that goes."""
    once, often = (each.id for each in project.frames.of()[:2])

    def say(frame: int, source: str, places: Iterable[int]) -> None:
        rank = SOURCES.index(source)
        # the surest one is another source at each place
        found = [(5.0 * place + 0.02 * rank, 0.9 - 0.3 * ((rank + place) % 3)) for place in sorted(places)]
        if rank:
            bring(project, frame, source, *(box(x, score) for x, score in found))
        else:
            ours = [proposal_at(x, score=score) for x, score in found]
            change = by_machine(project.frames.get(frame).revision)
            project.proposals.replace(frame, ours, change, track_ids=[7 + place for place in sorted(places)])

    def columns(frame: int) -> list[dict[str, object]]:
        left_out = ("id", "time_ns", "uid", "frame_id", "moment_id", "said")
        with project.store.read() as connection:
            rows = connection.execute(select(labels).where(labels.c.frame_id == frame)).mappings().all()
        assert all(row["proposed_box"] is not None for row in rows if row["source"] == Source.AUTO.value)
        return sorted(({name: row[name] for name in row if name not in left_out} for row in rows), key=repr)

    for source, places in told:
        say(often, source, places)
    for source in SOURCES:
        for frame in (once, often) if source not in dict(told) else (once,):
            say(frame, source, dict(told).get(source, ()))
    of = [[_shown(each) for each in project.labels.select() if each.frame_id == frame] for frame in (once, often)]
    assert sorted(of[0]) == sorted(of[1])
    assert columns(once) == columns(often)


def test_reviewed_labels_stay_and_cover(project: Project, frame: int) -> None:
    states = [ReviewState.ACCEPTED, ReviewState.EDITED, ReviewState.REJECTED]
    made = [NewLabel("hand", box_at(5.0 * n), state=state, track_id=n) for n, state in enumerate(states)]
    project.labels.create(frame, made, by_hand())
    new = [box(0.01), box(5.01), box(10.01), box(0.01, label="person"), box(30.0, track_id=1), box(35.0, track_id=2)]
    assert bring(project, frame, "one", *new) == (3, 0, 3)
    labels = project.labels.of_frame(frame)
    assert [label.state for label in labels[:3]] == states
    # a reviewed box keeps its track
    assert [(label.label, label.track_id) for label in labels[3:]] == [("person", None), ("hand", None), ("hand", 2)]


def test_who_said_it_stays_known_after_an_edit_and_moves_with_the_cloud(project: Project, frame: int) -> None:
    bring(project, frame, "one", box(0.0, 0.9))
    bring(project, frame, "two", box(0.02, 0.4))
    (stored,) = project.labels.select()
    uid = stored.label.uid
    project.labels.edit(frame, uid, revised(project, frame), label="person", box=box_at(0.1))
    recording = project.frames.get(frame).recording_id
    project.adjustments.correct(recording, Correction((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), "ann")
    said = project.labels.get(uid).said
    assert [(each.source, each.box.center_m[0]) for each in said] == [("one", 1.0), ("two", 1.02)]


def test_words_are_stored_once_until_a_row_says_something_else(project: Project, frame: int) -> None:
    put(project, COLOUR)
    project.proposals.bring("one", {frame: [NewLabel("hand", box_at(), 0.9, 5, attributes={"colour": "red"})]})
    bring(project, frame, "two", box(0.02, 0.4, track_id=5))
    uid = project.labels.select()[0].label.uid

    def words() -> list[tuple[object, ...]]:
        said = project.labels.get(uid).said
        return [(each.source, each.label, each.box.center_m[0], each.track_id, each.attributes) for each in said]

    def stored() -> list[str | None]:
        with project.store.read() as connection:
            return list(connection.exec_driver_sql("SELECT said FROM labels ORDER BY id").scalars())

    before = words()
    assert before == [("one", "hand", 0.0, 5, {"colour": "red"}), ("two", "hand", 0.02, 5, {})]
    assert stored() == [None, None]
    # whoever undoes first, in a row that the other has changed as well
    linked = TracksLinked(labels=(LabelChanged(uid=uid, track_id=7, box=BoxRecord.of(box_at(3.0))),))
    for steps in (["bob", "ann"], ["ann", "bob"]):
        linking = replace(by_machine(project.frames.get(frame).revision), author="ann")
        project.log.append(frame, [linked], linking, new_action())
        changed = LabelChanged(uid=uid, label="person", attributes={"colour": "blue"})
        project.log.append(frame, [changed], replace(revised(project, frame), author="bob"))
        assert words() == before
        for author in steps:
            project.history.undo(author)
            assert words() == before
        assert project.labels.get(uid).label.track_id == 5
        assert stored() == [None, None] or steps[0] == "ann"
    # as earlier versions have stored all of them
    with project.store.write() as connection:
        row = read_row(connection, "labels", uid)
        assert row is not None
        connection.exec_driver_sql("UPDATE labels SET said = ? WHERE uid = ?", (said_json(row), uid))
    assert words() == before
    bring(project, frame, "three", box(0.01, 0.6))
    assert [each[0] for each in words()] == ["one", "three", "two"]


def test_a_score_beyond_1_is_refused(project: Project, frame: int) -> None:
    with pytest.raises(ProjectError, match=r"a score of one must be in 0\.\.1, not 1\.5"):
        bring(project, frame, "one", box(0.0, 1.5))
    assert project.labels.select() == ()


def test_the_queue_tells_the_sources_of_each_object_and_filters_by_them(project: Project, frame: int) -> None:
    odd = 'their "best"\\ détector'
    project.proposals.replace(frame, [proposal_at(0.0, score=0.9), proposal_at(5.0)], by_machine())
    bring(project, frame, "one", box(0.01, 0.5), box(10.0))
    bring(project, frame, odd, box(10.02, 0.1), box(20.0))

    def queued(source: str | None) -> list[tuple[str, ...]]:
        found, total = waiting(project.store, By.FRAME, source=source, most=10)
        assert len(found) == total
        return sorted(each.sources for each in found)

    assert queued(None) == sorted([("annotator", "one"), ("annotator",), ("one", odd), (odd,)])
    assert queued("annotator") == [("annotator",), ("annotator", "one")]
    assert queued("one") == [("annotator", "one"), ("one", odd)]
    assert queued(odd) == [("one", odd), (odd,)]
    assert queued("on") == []
    assert waiting_sources(project.store) == {"annotator": 2, "one": 2, odd: 2}
    # a surer box hides ours, which stays a source of the object
    bring(project, frame, "one", box(0.01, 1.0))
    assert queued("annotator") == [("annotator",), ("one", "annotator")]
    assert waiting_sources(project.store) == {"annotator": 2, "one": 1, odd: 2}


def test_an_import_over_several_frames_is_undone_and_redone_as_one_step(project: Project, frame: int) -> None:
    other = project.frames.of()[0].id
    project.proposals.replace(frame, [proposal_at(0.0, score=0.5)], by_machine())
    bring(project, frame, "one", box(5.0))
    before, action = shown(project), new_action()
    for place in (frame, other):
        project.proposals.bring("two", {place: [box(0.01, 1.0), box(5.01, 0.4), box(10.0)]}, "Ada", action)
    after = shown(project)
    assert [who for who, *_ in after].count("two") == 5
    assert project.history.next("Ada")[0].startswith("import boxes of two (frames ")
    # a renamed class is no obstacle, a review by somebody else is one
    project.change_classes(edit.RenameClass(name="hand", new="paw"), "Eve")
    project.history.undo("Ada")
    assert shown(project) == before
    project.history.redo("Ada")
    assert shown(project) == after
    project.labels.reject(other, project.labels.of_frame(other)[0].uid, revised(project, other))
    with pytest.raises(HistoryError, match="the paw label was changed by ann"):
        project.history.undo("Ada")


COLOUR = Attribute(name="colour", kind=AttributeKind.CHOICE, choices=("red", "blue"))


@pytest.mark.parametrize(
    ("change", "after"),
    [
        (edit.RenameAttribute(name="colour", choice="blue", new="navy"), {"colour": "navy"}),
        (edit.RemoveAttribute(name="colour"), {}),
    ],
)
def test_values_that_sources_gave_follow_their_attributes(
    project: Project, frame: int, change: Callable[[ProjectConfig], ClassEdit], after: dict[str, str]
) -> None:
    put(project, COLOUR)
    bring(project, frame, "one", NewLabel("hand", box_at(), 0.9, attributes={"colour": "red"}))
    bring(project, frame, "two", NewLabel("hand", box_at(0.02), 0.5, attributes={"colour": "blue"}))
    project.change_classes(change, "ann")
    (stored,) = project.labels.select()
    assert stored.said[1].attributes == after
    bring(project, frame, "one")
    assert project.labels.select()[0].label.attributes == after


@pytest.mark.parametrize("ours", [False, True])
def test_a_proposal_has_the_values_of_all_its_sources(project: Project, frame: int, ours: bool) -> None:
    pose = Attribute(name="pose", kind=AttributeKind.TEXT, default="standing")
    put(project, COLOUR, pose, Attribute(name="worn", kind=AttributeKind.BOOLEAN))

    def say(source: str, score: float, **values: str | bool) -> int:
        boxes = [NewLabel("hand", box_at(0.02), score, attributes=values)]
        return project.proposals.bring(source, {frame: boxes}, "ann", new_action())[frame].conflicts

    def values() -> dict[str, object]:
        (stored,) = project.labels.select()
        return dict(stored.label.attributes)

    own: dict[str, object] = {"pose": "standing"}
    if ours:
        project.proposals.replace(frame, [proposal_at(0.0, "hand", 0.95)], by_machine())
    else:
        say("one", 0.9, colour="red")
        own["colour"] = "red"
    # a conflict is one of the source itself
    assert say("two", 0.5, colour="blue", worn=True) == (0 if ours else 1)
    assert say("three", 0.4, pose="sitting", worn=False, colour="blue") == (1 if ours else 2)
    every = {"colour": "blue", "worn": True} | own | {"pose": "sitting"}
    assert values() == every
    # each source takes its own words back
    project.proposals.bring("two", {frame: []})
    assert values() == every | {"worn": False}
    project.proposals.bring("three", {frame: []})
    assert values() == own


SIDE = Attribute(name="side", kind=AttributeKind.TEXT, of=AttributeOf.TRACK)


def say(project: Project, frame: int, source: str, score: float, **values: str) -> Brought:
    """Lets a source say something of one object, which has track 5 in the files of all sources."""
    boxes = [NewLabel("hand", box_at(0.02), score, 5, attributes=values)]
    return project.proposals.bring(source, {frame: boxes}, "ann", new_action())[frame]


def test_what_is_filled_in_later_is_not_lent(project: Project, frame: int) -> None:
    say(project, frame, "one", 0.9)
    pose = Attribute(name="pose", kind=AttributeKind.TEXT, default="standing")
    put(project, pose)
    (stored,) = project.labels.select()
    assert stored.label.attributes == {"pose": "standing"}
    put(project, pose.model_copy(update={"default": "sitting"}))
    project.proposals.bring("two", {frame: [box(9.0, 0.5)]})
    assert project.labels.get(stored.label.uid).label.attributes == {"pose": "standing"}


def test_a_lent_value_of_a_track_goes_with_its_source(project: Project, frame: int, recording: StoredRecording) -> None:
    put(project, SIDE)
    two_frames = (frame, project.frames.of([recording.id])[3].id)

    def sides() -> list[object]:
        return [each.label.attributes.get("side") for each in project.labels.select()]

    for number in two_frames:
        say(project, number, "one", 0.9)
    for number in two_frames:
        say(project, number, "two", 0.5, side="left")
    assert sides() == ["left", "left"]
    for number in two_frames:
        project.proposals.bring("two", {number: []})
    assert sides() == [None, None]
    # what a person has said since stays, also in the other frame
    for number in two_frames:
        say(project, number, "two", 0.5, side="left")
    first = project.labels.select()[0].label.uid
    project.labels.set_attributes(frame, first, {"side": "right"}, revised(project, frame))
    assert sides() == ["right", "right"]
    assert say(project, two_frames[1], "three", 0.4, side="left").conflicts == 1
    assert sides() == ["right", "right"]


def test_our_proposal_with_a_lent_value_is_not_kept(project: Project, frame: int) -> None:
    put(project, SIDE, COLOUR)
    project.proposals.replace(frame, [proposal_at(0.0, "hand", 0.95)], by_machine())
    say(project, frame, "two", 0.5, colour="blue")
    (stored,) = project.labels.select()
    for side in ("left", None):
        project.labels.set_attributes(frame, stored.label.uid, {"side": side}, revised(project, frame))
    project.proposals.replace(frame, [], by_machine(project.frames.get(frame).revision))
    assert shown(project) == [("two", 0.02, [])]


def test_where_the_class_of_the_shown_box_is_removed_another_source_is_shown(project: Project, frame: int) -> None:
    project.proposals.replace(frame, [proposal_at(0.0, "person", 0.9), proposal_at(5.0, score=0.3)], by_machine())
    bring(project, frame, "one", box(0.02, 0.5), box(5.02, 0.8, "person"), box(10.0, 0.4, "person"))
    bring(project, frame, "two", box(0.04, 0.3), box(15.0, 0.6, "person"))
    other = project.frames.of()[3].id
    bring(project, other, "one", box(0.0, 0.9, "person"))
    bring(project, other, "two", box(0.1, 0.5))
    project.labels.accept(other, project.labels.of_frame(other)[0].uid, revised(project, other))
    assert project.class_counts() == {"hand": ClassCounts(0, 0, 4), "person": ClassCounts(5, 0, 0)}
    project.change_classes(edit.RemoveClass(name="person", with_boxes=True), "ann")
    # also behind the reviewed label, which goes; an automatic pass's values are as before
    assert shown(project) == [("one", 0.02, ["two"]), ("ours", 5.0, []), ("two", 0.1, [])]
    assert project.class_counts() == {"hand": ClassCounts(3, 0, 1)}
    bring(project, frame, "one")
    assert shown(project) == [("ours", 5.0, []), ("two", 0.04, []), ("two", 0.1, [])]
    assert verify(project.path, deep=True).problems == ()


def test_another_source_is_shown_in_finalised_frames_and_removed_recordings(
    project: Project, frame: int, recording: StoredRecording
) -> None:
    bring(project, frame, "one", box(0.0, 0.9, "person"))
    bring(project, frame, "two", box(0.1, 0.5))
    project.frames.finalise(frame, revised(project, frame))
    project.recordings.remove(recording.id, "ann")
    project.change_classes(edit.RemoveClass(name="person", with_boxes=True), "ann")
    project.recordings.rescan(recording.id, [str(n) for n in range(5)])
    assert shown(project) == [("two", 0.1, [])]
    assert verify(project.path, deep=True).problems == ()


def test_what_is_behind_a_label_of_a_removed_camera_comes_back_with_it(project: Project, tmp_path: Path) -> None:
    cloud = {"0": SharedCloud("0", RigidTransform.identity())}
    for name in ("one", "two"):
        options = json.dumps({"camera": name})
        project.recordings.add(tmp_path, "rgbd", name, ["0"], True, options=options, clouds=cloud)
    here, there = (frame.id for frame in project.frames.of())
    bring(project, here, "one", box(0.0, 0.9))
    bring(project, here, "two", box(0.1, 0.5))
    (label,) = project.labels.of_frame(here)
    drawn = LabelChanged(
        state=ReviewState.EDITED,
        uid=label.uid,
        label="hand",
        box=BoxRecord.of(label.box),
        image_box=Box2D("hand", 0.0, 0.0, 9.0, 9.0),
    )
    project.log.append(there, [drawn], revised(project, there))
    project.recordings.remove(2, "ann")
    bring(project, here, "three", box(5.0))
    assert shown(project) == [("three", 5.0, [])]
    project.recordings.rescan(2, ["0"], clouds=cloud)
    assert [[each.source for each in stored.said] for stored in project.labels.select()] == [["three"], ["one", "two"]]
    assert verify(project.path, deep=True).problems == ()


def test_a_class_that_only_hidden_boxes_have_counts_as_used(project: Project, frame: int) -> None:
    bring(project, frame, "one", box(0.0, 0.9))
    bring(project, frame, "two", box(0.1, 0.5, "person"))
    with pytest.raises(ProjectError, match="'person' cannot be removed while boxes use it"):
        project.configure(classes=["hand"])
