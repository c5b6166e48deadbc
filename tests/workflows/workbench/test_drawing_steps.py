"""The five drags of an object: computing views and boxes without state, and storing them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import same_box
from annotator.project import NewLabel, Origin, Project, WriteContext
from annotator.project.audit.events import Effort
from annotator.project.changes import LabelChanged
from annotator.project.labels import Labels
from annotator.project.overview import read_page
from annotator.project.progress.reviewed import draft_id
from annotator.project.records import ViewGeometry
from annotator.rcv.known_objects import Span
from annotator.rcv.teach import TaughtObject
from annotator.recordings import open_recording
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, Proposal, PseudoView, Quality, ReviewState, Source
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.simulate import _draw, image_box_of, visible_objects
from annotator.workflows.workbench.drawing_steps import (
    LABEL_VIEW_PX,
    Fit,
    Labelling,
    frame_config,
    label_config,
    label_object,
    label_steps,
)
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import shown_objects
from annotator.workflows.workbench.loaded_detectors import ReadyDetector
from annotator.workflows.workbench.refit import FoundBox
from annotator.workflows.workbench.save_object import ObjectDrawn, save_object


class Desk:
    """The first frame of a project, its true objects, and a simulated operator."""

    def __init__(self, project: Project, folder: Path, kind: BoxKind = BoxKind.SILHOUETTE) -> None:
        recording = open_recording(folder)
        self.project, self.kind = project, kind
        self.frame: Frame = recording.frame(0)
        self.frame_id = project.frames.of()[0].id
        self.objects: list[TaughtObject] = visible_objects(recording, 0, self.frame, project.config.classes)
        self.opened = OpenFrame(self.frame)
        self.config = label_config(project, self.frame)

    def image_box(self, number: int = 0) -> Box2D:
        box = image_box_of(self.frame, self.objects[number], self.kind)
        assert box is not None
        return box

    def draw(self, view: PseudoView, number: int = 0) -> Box2D:
        box = _draw(view, frame=self.frame, item=self.objects[number], kind=self.kind)
        assert box is not None
        return box

    def steps(self, boxes: Sequence[Box2D | None], number: int = 0) -> Labelling:
        return label_steps(self.opened, self.image_box(number), boxes, self.config, self.kind)

    def object(self, image_box: Box2D, boxes: Sequence[Box2D | None], uid: str | None = None) -> ObjectDrawn:
        labelling = label_steps(self.opened, image_box, boxes, self.config, self.kind)
        return ObjectDrawn(image_box, labelling, uid)

    def fit(self, found: OrientedBox | None, asked: list[Sequence[Span]]) -> Fit:
        """Answers with the same 3D box each time, and records the spans that it was asked with."""

        def fit(known: Sequence[Span]) -> FoundBox:
            asked.append(list(known))
            outline = np.zeros((0, 2, 2))
            return FoundBox(found, outline, 0, None, None, None if found else "nothing here")

        return fit

    def four(self, number: int = 0) -> list[Box2D]:
        boxes: list[Box2D] = []
        for place in range(4):
            boxes.append(self.draw(self.steps(boxes, number).views[place], number))
        return boxes

    @property
    def revision(self) -> int:
        return self.project.frames.get(self.frame_id).revision

    def save(self, image_boxes: Sequence[Box2D], drawn: ObjectDrawn | None, revision: int | None = None) -> str | None:
        context = WriteContext(self.revision if revision is None else revision, "ann", effort=Effort(1, 2.0))
        return save_object(self.project, self.frame_id, self.opened, image_boxes, self.kind, drawn, context)


@pytest.fixture
def desk(people: Project, generated: Path) -> Desk:
    return Desk(people, generated / "people")


def test_each_completed_step_gives_the_next_views_and_a_box(desk: Desk) -> None:
    four = desk.four()
    begun = desk.steps([])
    assert (len(begun.steps), begun.box, begun.stop) == (1, None, None)
    assert begun.points > 100
    # large enough to draw on, whatever size the detector needs
    assert frame_config(desk.project, desk.frame).view_px < LABEL_VIEW_PX
    assert {max(view.rgb.shape) for view in begun.views} == {LABEL_VIEW_PX}
    assert len(desk.steps(four[:1]).steps) == 1
    assert len(desk.steps([None, four[1]]).steps) == 1, "the next step needs both boxes"
    second = desk.steps(four[:2])
    assert len(second.steps) == 2
    assert second.box is not None
    assert len(desk.steps(four[:3]).steps) == 2
    done = desk.steps(four)
    assert done.box is not None
    truth = desk.objects[0].box
    assert iou_3d(done.box, truth) > 0.4
    assert iou_3d(done.box, truth) > iou_3d(second.box, truth) - 0.1
    assert len(done.outline) > 6
    assert done.points > 50


def test_a_box_that_somebody_accepts_meanwhile_does_not_move_along_with_a_redrawn_one(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    project, image_box, four = desk.project, desk.image_box(), desk.four()
    uid = desk.save([image_box], desk.object(image_box, four))
    assert uid is not None
    project.log.append(desk.frame_id, [LabelChanged(uid=uid, track_id=3)], WriteContext(desk.revision, "ann"))
    box, later = project.labels.get(uid).label.box, project.frames.of()[1].id
    new = NewLabel("person", box, track_id=3, state=ReviewState.PROPOSED)
    (other,) = project.labels.create(later, [new], WriteContext(0, "ann")).uids

    def meanwhile(labels: Labels, boxes: Any) -> Any:
        monkeypatch.undo()
        found = labels.near(boxes)
        with ThreadPoolExecutor(1) as threads:
            threads.submit(project.labels.accept, later, other, WriteContext(1, "bob")).result()
        return found

    monkeypatch.setattr(Labels, "near", meanwhile)
    last = four[-1]
    wider = replace(last, x_max=last.x_max + 40)
    assert desk.save([image_box], desk.object(image_box, [*four[:3], wider], uid)) == uid
    assert not same_box(project.labels.get(uid).label.box, box)
    kept = project.labels.get(other).label
    assert kept.state is ReviewState.ACCEPTED and same_box(kept.box, box)


def test_boxes_without_points_give_a_reason(desk: Desk) -> None:
    far = Box2D("person", -900.0, -900.0, -800.0, -800.0)
    found = label_steps(desk.opened, far, [], desk.config)
    assert (found.steps, found.points) == ((), 0)
    assert found.stop is not None and "points lie in this box's frustum" in found.stop
    # no point in common
    views = desk.steps([]).views
    height, width = views[0].rgb.shape[:2]
    corner = Box2D("person", -0.5, -0.5, 0.4, 0.4)
    other = Box2D("person", width - 1.5, height - 1.5, width - 0.6, height - 0.6)
    found = desk.steps([corner, other])
    assert len(found.steps) == 1
    assert found.stop is not None and "lie in both boxes" in found.stop


def test_after_the_image_box_all_views_have_a_suggestion_and_these_give_the_found_box(desk: Desk) -> None:
    true = desk.objects[0].box
    for kind in BoxKind:
        found = label_steps(desk.opened, desk.image_box(), [], desk.config, kind, fit=desk.fit(true, []))
        suggested = [box for step in found.steps for box in step.suggested]
        assert len(suggested) == 4 and None not in suggested
        for view, box in zip(found.views, suggested, strict=True):
            assert box is not None and box.label == "person"
            height_px, width_px = view.rgb.shape[:2]
            assert -0.5 <= box.x_min < box.x_max <= width_px - 0.5 and -0.5 <= box.y_min < box.y_max <= height_px - 0.5
        assert found.box is not None
        # a silhouette ends with the visible points
        assert iou_3d(found.box, true) > (0.9 if kind is BoxKind.BOX else 0.5)
        # accepting them changes neither the views nor the 3D box
        axes = found.views[2].axes
        accepted = label_steps(desk.opened, desk.image_box(), suggested, desk.config, kind, axes=axes)
        assert [view is same for view, same in zip(accepted.views, found.views, strict=True)] == [True] * 4
        assert accepted.box is not None and same_box(accepted.box, found.box)


def test_the_fit_knows_the_drawn_boxes_and_only_the_other_views_have_suggestions(desk: Desk) -> None:
    asked: list[Sequence[Span]] = []
    fit = desk.fit(desk.objects[0].box, asked)
    whole = label_steps(desk.opened, desk.image_box(), [], desk.config, desk.kind, fit=fit)
    (front, side), (third, _) = (step.suggested for step in whole.steps)
    assert front is not None and side is not None and third is not None
    corrected = replace(front, x_max=front.x_max - 5.0)
    found = label_steps(desk.opened, desk.image_box(), [corrected], desk.config, desk.kind, fit=fit)
    assert found.steps[0].suggested[0] is None and found.steps[0].suggested[1] is not None
    assert [len(known) for known in asked] == [0, 1]
    axes, span_m = asked[1][0]
    np.testing.assert_array_equal(axes, whole.views[0].axes)
    np.testing.assert_allclose(span_m, whole.views[0].interval_m(corrected))
    # a box on the second step: its views keep their axes, and the other view takes over the shared span
    shorter = replace(third, y_min=third.y_min + 8.0)
    boxes, own = [front, side, shorter], whole.views[2].axes
    found = label_steps(desk.opened, desk.image_box(), boxes, desk.config, desk.kind, axes=own, fit=fit)
    assert [len(known) for known in asked] == [0, 1, 2, 3]
    np.testing.assert_array_equal(found.views[2].axes, own)
    last = found.steps[1].suggested[1]
    assert found.steps[1].suggested[0] is None and last is not None
    np.testing.assert_allclose(found.views[3].interval_m(last)[1], found.views[2].interval_m(shorter)[1], atol=0.02)


@pytest.mark.parametrize(("class_agnostic", "kind"), [(True, BoxKind.BOX), (False, BoxKind.SILHOUETTE)])
def test_a_class_agnostic_detector_suggests_boxes_of_the_kind_that_is_drawn(
    desk: Desk, knowing: Callable[..., Detectors], class_agnostic: bool, kind: BoxKind
) -> None:
    detector = ReadyDetector(knowing("people").view, BoxKind.SILHOUETTE, Lock(), class_agnostic)
    assert frame_config(desk.project, desk.frame, detector, BoxKind.BOX).box_kind is kind


def test_without_a_found_object_the_reason_is_told_and_boxes_can_be_drawn(desk: Desk) -> None:
    found = label_steps(desk.opened, desk.image_box(), [], desk.config, desk.kind, fit=desk.fit(None, []))
    assert found.note == "nothing here" and found.steps[0].suggested == (None, None) and found.box is None
    four = desk.four()
    found = label_steps(desk.opened, desk.image_box(), four, desk.config, desk.kind, fit=desk.fit(None, []))
    assert found.box is not None and found.note is None, "nothing is left to suggest"


def test_a_detector_that_fails_leaves_drawing_possible(desk: Desk, caplog: pytest.LogCaptureFixture) -> None:
    broken = Mock(labels=("person",), fingerprint="broken", detect=Mock(side_effect=RuntimeError("secret")))
    detector = ReadyDetector(broken, BoxKind.SILHOUETTE, Lock())
    found = label_object(desk.project, desk.opened, desk.image_box(), [], desk.kind, (), detector)
    assert len(found.views) == 2 and found.note == "internal error, see the server's log"
    assert "secret" in caplog.text


def test_each_drag_is_stored_and_the_fifth_creates_the_label(desk: Desk) -> None:
    image_box, four = desk.image_box(), desk.four()
    for count in range(5):
        uid = desk.save([image_box], desk.object(image_box, four[:count]))
        assert (uid is None) == (count < 4)
    (stored,) = desk.project.labels.select()
    assert stored.label.uid == uid
    assert (stored.label.state, stored.label.source) == (ReviewState.ACCEPTED, Source.MANUAL)
    assert (stored.origin, stored.image_box) == (Origin.DRAWN, image_box)
    views = desk.project.boxes.on_views_of(desk.frame_id)
    assert [view.step for view in views] == [0, 0, 1, 1]
    assert [view.boxes for view in views] == [(box,) for box in four]
    assert all(view.box_kind is BoxKind.SILHOUETTE for view in views)
    targets = {event.effort_target for event in desk.project.log.of_frame(desk.frame_id)}
    assert targets == {draft_id(desk.frame_id, image_box)}
    numbers = desk.project.statistics().effort
    assert (numbers.boxes, numbers.actions_a_box, numbers.seconds_a_box) == (1, 5.0, 10.0)
    assert numbers.by_origin["from nothing"].boxes == 1
    # one undo reverts one drag
    for left in (3, 2, 1, 0):
        desk.project.history.undo("ann")
        assert (desk.project.labels.select(), len(desk.project.boxes.on_views_of(desk.frame_id))) == ((), left)
    desk.project.history.undo("ann")
    assert desk.project.boxes.on_image(desk.frame_id) is None


def test_boxes_of_other_objects_on_a_view_are_kept(desk: Desk) -> None:
    """Views from 3D boxes also have boxes of other objects."""
    image_box, four = desk.image_box(), desk.four()
    desk.save([image_box], desk.object(image_box, four[:2]))
    view = next(view for view in desk.project.boxes.on_views_of(desk.frame_id) if view.boxes == (four[1],))
    other = Box2D("person", 1.0, 2.0, 9.0, 12.0)
    placed = {"frame_id": desk.frame_id, "step": view.step, "geometry": view.geometry}
    context = WriteContext(desk.revision, "import")
    desk.project.boxes.set_on_view(view.view_id, [four[1], other], desk.kind, context, **placed)
    before = desk.revision
    desk.save([image_box], desk.object(image_box, four[:2]))
    assert desk.revision == before, "nothing is new"
    wider = Box2D("person", *four[1].xyxy[:3], four[1].y_max + 2)
    desk.save([image_box], desk.object(image_box, [four[0], wider]))
    assert {view.boxes for view in desk.project.boxes.on_views_of(desk.frame_id)} == {(four[0],), (wider, other)}


def test_changing_a_box_of_the_first_step_removes_the_second_step(desk: Desk) -> None:
    image_box, four = desk.image_box(), desk.four()
    uid = desk.save([image_box], desk.object(image_box, four))
    lower = Box2D("person", four[0].x_min, four[0].y_min, four[0].x_max, four[0].y_max - 120)
    desk.save([image_box], desk.object(image_box, [lower, four[1]], uid))
    views = desk.project.boxes.on_views_of(desk.frame_id)
    assert sorted(view.step or 0 for view in views) == [0, 0]
    assert {view.boxes for view in views} == {(lower,), (four[1],)}
    assert desk.project.labels.get(uid or "").label.state is ReviewState.ACCEPTED, (
        "the label is kept until the new boxes are complete"
    )
    again = desk.steps([lower, four[1]])
    last = [desk.draw(view) for view in again.views[2:]]
    assert desk.save([image_box], desk.object(image_box, [lower, four[1], *last], uid)) == uid
    assert desk.project.labels.get(uid or "").label.state is ReviewState.EDITED


def test_an_object_keeps_its_label_when_its_image_box_moves(desk: Desk) -> None:
    image_box, four = desk.image_box(), desk.four()
    uid = desk.save([image_box], desk.object(image_box, four))
    x_min, y_min, x_max, y_max = image_box.xyxy
    moved = Box2D("person", x_min - 30, y_min - 2, x_max + 30, y_max + 2)
    assert desk.save([moved], desk.object(moved, [], uid)) == uid
    (shown,) = shown_objects(read_page(desk.project, desk.frame_id))
    assert (shown.image_box, shown.uid) == (moved, uid), "it is the same object, also after a reload"
    assert desk.project.boxes.on_views_of(desk.frame_id) == (), "views of the old frustum are removed"
    boxes: list[Box2D] = []
    for place in range(4):
        views = label_steps(desk.opened, moved, boxes, desk.config).views
        boxes.append(desk.draw(views[place]))
    assert desk.save([moved], desk.object(moved, boxes, uid)) == uid
    (stored,) = desk.project.labels.select()
    assert stored.image_box == moved
    assert stored.label.state is ReviewState.EDITED


def test_boxes_keep_their_place_on_the_views_of_a_moved_image_box(desk: Desk) -> None:
    image_box, four = desk.image_box(), desk.four()
    before = desk.steps(four)
    planes = [ViewGeometry.of(view) for view in before.views]
    x_min, y_min, x_max, y_max = image_box.xyxy
    moved = Box2D("person", x_min - 30, y_min - 2, x_max + 30, y_max + 2)
    after = label_steps(desk.opened, moved, four, desk.config, desk.kind, planes=planes)
    assert [view.metres_per_px for view in after.views] != [view.metres_per_px for view in before.views]
    for old, new, was, now in zip(before.views, after.views, four, after.drawn, strict=True):
        assert now is not None and now.xyxy != was.xyxy
        np.testing.assert_allclose(new.interval_m(now), old.interval_m(was), atol=1e-9)
    assert before.box is not None and after.box is not None
    assert same_box(before.box, after.box)
    # the second step has the axes of its boxes, also if only the side is drawn
    side = label_steps(
        desk.opened, moved, [*four[:2], None, four[3]], desk.config, planes=[*planes[:2], None, planes[3]]
    )
    np.testing.assert_allclose(side.views[2].axes, planes[2].axes, atol=1e-9)
    # a box is gone from a view with other axes, or outside what it shows
    turned = planes[0].model_copy(update={"axes": planes[1].axes})
    far = planes[1].model_copy(update={"origin_m": (99.0, 0.0)})
    assert label_steps(desk.opened, moved, four[:2], desk.config, planes=[turned, far]).drawn == (None, None)


def test_changing_the_class_keeps_a_corrected_box(desk: Desk) -> None:
    desk.project.configure(classes=["person", "robot"])
    image_box, four = desk.image_box(), desk.four()
    uid = desk.save([image_box], desk.object(image_box, four)) or ""
    better = OrientedBox.from_parts(np.array([0.5, 0.1, 3.0]), np.eye(3), np.array([0.7, 0.4, 1.8]))
    desk.project.labels.edit(
        desk.frame_id, uid, WriteContext(desk.revision, "bob"), label="person", box=better, track_id=7
    )

    def present() -> tuple[str, bool, int | None, Box2D | None]:
        stored = desk.project.labels.get(uid)
        label = stored.label
        return label.label, iou_3d(label.box, better) > 1 - 1e-9, label.track_id, stored.image_box

    before = desk.revision
    assert desk.save([image_box], desk.object(image_box, four, uid)) == uid
    assert desk.revision == before, "saving the same boxes does not overwrite it"
    renamed, boxes = replace(image_box, label="robot"), [replace(box, label="robot") for box in four]
    assert desk.save([renamed], desk.object(renamed, boxes, uid)) == uid
    assert present() == ("robot", True, 7, renamed)
    desk.project.history.undo("ann")
    assert present() == ("person", True, 7, image_box)
    desk.project.history.redo("ann")
    wider = replace(boxes[3], x_max=boxes[3].x_max + 2)
    desk.save([renamed], desk.object(renamed, [*boxes[:3], wider], uid))
    assert present()[1] is False, "another drag changes the box"


def test_effort_is_kept_when_the_image_box_of_a_draft_changes(desk: Desk) -> None:
    image_box = desk.image_box()
    x_min, y_min, x_max, y_max = image_box.xyxy
    sloppy = Box2D("person", x_min - 20, y_min - 20, x_max + 20, y_max)
    desk.save([sloppy], None)
    desk.save([image_box], None)
    desk.save([image_box], desk.object(image_box, desk.four()))
    numbers = desk.project.statistics().effort
    assert (numbers.boxes, numbers.actions_a_box) == (1, 3.0)


def test_invalid_saves_are_errors_and_change_nothing(desk: Desk) -> None:
    image_box = desk.image_box()
    with pytest.raises(ConfigError, match="4 boxes on its views, not 5"):
        desk.steps([None] * 5)
    with pytest.raises(ConfigError, match="is not among image_boxes"):
        desk.save([], desk.object(image_box, []))
    with pytest.raises(NotFoundError, match="has no label ab"):
        desk.save([image_box], desk.object(image_box, desk.four(), "ab"))
    with pytest.raises(StaleRevisionError, match="is at revision 0, but the change was made on revision 3"):
        desk.save([image_box], None, revision=3)
    assert desk.revision == 0


def test_the_first_boxes_on_the_views_of_a_proposal_are_no_review_of_it(desk: Desk) -> None:
    true, image_box, four = desk.objects[0].box, desk.image_box(), desk.four()
    proposal = Proposal("person", 0.8, true, image_box, (), Quality(0.1, 0.9, 0.05, 0.8, 0.2))
    context = WriteContext(desk.revision, "rcv", Source.AUTO)
    (uid,) = desk.project.proposals.replace(desk.frame_id, [proposal], context).uids
    assert uid is not None
    states = []
    for boxes in (four[:1], four):
        assert desk.save([image_box], desk.object(image_box, boxes, uid)) == uid
        states.append(desk.project.labels.get(uid).label.state)
    assert states == [ReviewState.PROPOSED, ReviewState.EDITED]
