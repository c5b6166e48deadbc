"""What an operator's changes to a frame store: drawn objects, and the changes that others imply, each as one action."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from annotator.geometry.oriented_box import same_box
from annotator.project import REVIEWED, FramePart, Origin, Project, Receipt, StoredFrame, WriteContext
from annotator.project.changes import ImageBoxesSet, LabelChanged, LabelDeleted, NewLabel, Payload, ViewBoxesSet
from annotator.project.overview import FramePage, read_page
from annotator.project.progress.reviewed import draft_id
from annotator.project.records import BoxRecord
from annotator.rcv.config import RcvConfig
from annotator.types import Box2D, BoxKind, OrientedBox, ReviewState, Suggestion
from annotator.types.errors import ConfigError, StaleRevisionError
from annotator.workflows.tracks.key_frames import moved_along
from annotator.workflows.tracks.propose_boxes import around, label_of, proposal_events, proposal_like, why_left_out
from annotator.workflows.tracks.timeline import OpenRecording
from annotator.workflows.views import changes_kind, geometry_of, image_follower, view_followers
from annotator.workflows.workbench.drawing_steps import (
    MAX_BOXES,
    VIEWS_PER_STEP,
    Labelling,
    label_config,
    label_steps,
)
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import ShownObject, shown_objects


def remeasured(page: FramePage, opened: OpenFrame, config: RcvConfig, on_image: ImageBoxesSet) -> list[LabelChanged]:
    """Returns the edits of those labels whose drawn boxes now give another 3D box, except labels corrected since.

    Args:
        config: with the orientation for the frame.
        on_image: the new boxes on the image, and what they measure.
    """
    if page.image_boxes is None or not changes_kind(page, on_image):
        return []
    labels = {stored.label.uid: stored.label for stored in page.labels}
    edits = []
    for item in shown_objects(page):
        if item.uid is None or item.image_box not in on_image.boxes:
            continue
        label = labels[item.uid]
        before, now = (_measured(opened, item, config, kind) for kind in (page.image_boxes.box_kind, on_image.box_kind))
        if before is None or now is None or not same_box(before, label.box):
            continue
        if same_box(now, label.box) and label.box_kind is on_image.box_kind:
            continue
        edits.append(
            LabelChanged(
                state=ReviewState.EDITED,
                uid=label.uid,
                box=BoxRecord.of(now),
                image_box=item.image_box,
                suggestion=label.suggestion,  # nobody has corrected it
                box_kind=on_image.box_kind,
            )
        )
    return edits


def _measured(opened: OpenFrame, item: ShownObject, config: RcvConfig, kind: BoxKind) -> OrientedBox | None:
    """Returns the 3D box that an object's drawn boxes give; None if one of these is missing."""
    if len(item.views) != MAX_BOXES or any(len(view.boxes) != 1 for view in item.views):
        return None
    boxes, geometry = [view.boxes[0] for view in item.views], item.views[VIEWS_PER_STEP].geometry
    axes = None if geometry is None else np.array(geometry.axes)
    return label_steps(opened, item.image_box, boxes, config, kind, axes=axes).box


@dataclass(frozen=True)
class ObjectDrawn:
    """An object with the boxes drawn so far.

    Attributes:
        uid: of the object's label, or None while it has none.
        suggestion: the detector that suggested boxes, if the operator accepted any.
    """

    image_box: Box2D
    labelling: Labelling
    uid: str | None = None
    suggestion: Suggestion | None = None


def save_object(
    project: Project,
    frame_id: int,
    opened: OpenFrame,
    image_boxes: Sequence[Box2D],
    kind: BoxKind,
    drawn: ObjectDrawn | None,
    context: WriteContext,
    recordings: OpenRecording | None = None,
) -> str | None:
    """Stores the boxes on the image and on an object's views and, once all four are drawn, its 3D label: all or none.

    Returns the uid of the object's label, if it has one.

    Boxes on a view are removed if their image box is gone, or if an earlier box of the object has changed, which gives
    the object another view: the old view is no longer a step of any object.

    Args:
        image_boxes: all boxes of the image, the object's included.
        kind: what the boxes measure.
        recordings: as for `apply_changes`.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        NotFoundError: no such frame or label.
        ConfigError: the object's image box is not in `image_boxes`, or it has more than four boxes.
        ProjectError: unknown class.
    """
    page = read_page(project, frame_id)
    if page.frame.revision != context.revision:
        raise StaleRevisionError("this frame", context.revision, page.frame.revision)
    if drawn is not None and drawn.image_box not in image_boxes:
        raise ConfigError("the object's image_box is not among image_boxes; send all boxes of the image")
    on_image = ImageBoxesSet(boxes=tuple(image_boxes), box_kind=kind)
    payloads: list[Payload] = []
    if page.image_boxes is None or (page.image_boxes.boxes, page.image_boxes.box_kind) != (on_image.boxes, kind):
        payloads.append(on_image)
    uid = None
    view_boxes: list[ViewBoxesSet] = []
    if drawn is not None:
        view_boxes = _view_boxes(project, page, opened, drawn, kind)
        label = _label_change(page, drawn, view_boxes, kind)
        uid = _label_uid(page, drawn) if label is None else label.uid
        payloads += _new_views(page, view_boxes) + ([] if label is None else [label])
    redrawn = None if drawn is None else drawn.image_box
    payloads += view_followers(page, on_image, redrawn=redrawn, kept={entry.view for entry in view_boxes})
    if changes_kind(page, on_image):
        others = remeasured(page, opened, label_config(project, opened.frame), on_image)
        payloads += [entry for entry in others if entry.uid != uid]
    if payloads:
        target = context.effort_target or _effort_target(page, image_boxes, drawn, uid)
        corrected = [entry for entry in payloads if isinstance(entry, LabelChanged) and entry.uid == uid]
        parts = [FramePart(frame_id, payloads, replace(context, effort_target=target))]
        _append(project, frame_id, corrected, context, lambda _: parts, recordings)
    return uid


def _view_boxes(
    project: Project, page: FramePage, opened: OpenFrame, drawn: ObjectDrawn, kind: BoxKind
) -> list[ViewBoxesSet]:
    """Returns the boxes of an object on its views.

    A view generated from 3D boxes has boxes of other objects, too: the object's box comes first, the others stay.
    """
    known = {view.view_id: view.boxes[1:] for view in page.view_boxes if view.box_kind is kind}
    events = []
    for place, (view, box) in enumerate(zip(drawn.labelling.views, drawn.labelling.drawn, strict=True)):
        if box is None:
            continue
        view_id = project.views.store(opened.picture(view))
        boxes, geometry = (box, *known.get(view_id, ())), geometry_of(view, drawn.image_box)
        events.append(
            ViewBoxesSet(view=view_id, boxes=boxes, box_kind=kind, step=place // VIEWS_PER_STEP, geometry=geometry)
        )
    return events


def _new_views(page: FramePage, view_boxes: Sequence[ViewBoxesSet]) -> list[Payload]:
    known = {view.view_id: (view.boxes, view.box_kind, view.step, view.geometry) for view in page.view_boxes}
    return [
        entry
        for entry in view_boxes
        if known.get(entry.view) != (entry.boxes, entry.box_kind, entry.step, entry.geometry)
    ]


def _label_change(
    page: FramePage, drawn: ObjectDrawn, view_boxes: Sequence[ViewBoxesSet], kind: BoxKind
) -> NewLabel | LabelChanged | None:
    """Returns the creation or the edit of the object's 3D label, or None if there is nothing to change.

    A label is created once all four boxes are drawn. An existing label gets a new 3D box only if the drawn boxes have
    changed and are complete: its present box may be a correction. Otherwise only its class and image box are updated.
    """
    labelling = drawn.labelling
    is_complete = len(labelling.views) == 2 * VIEWS_PER_STEP and None not in labelling.drawn
    measured = labelling.box if is_complete else None
    uid = _label_uid(page, drawn)
    name, image_box, suggestion = drawn.image_box.label, drawn.image_box, drawn.suggestion
    if uid is None:
        if measured is None:
            return None
        return NewLabel(name, measured, origin=Origin.DRAWN, suggestion=suggestion, image_box=image_box, box_kind=kind)
    present = label_of(page, uid)
    is_kept = measured is None or _are_drawn(page, view_boxes)
    box = present.label.box if is_kept or measured is None else measured
    is_same = same_box(present.label.box, box) and (is_kept or present.label.box_kind is kind)
    if is_same and (present.label.label, present.image_box) == (drawn.image_box.label, drawn.image_box):
        return None
    # the first boxes on the views of a proposal are no review of its 3D box
    is_open = is_kept and is_same and present.label.state is ReviewState.PROPOSED and present.label.label == name
    return LabelChanged(
        state=None if is_open else ReviewState.EDITED,
        uid=uid,
        box=BoxRecord.of(box),
        suggestion=None if is_kept else suggestion,
        box_kind=None if is_kept else kind,
        label=name,
        image_box=image_box,
    )


def _are_drawn(page: FramePage, view_boxes: Sequence[ViewBoxesSet]) -> bool:
    """Returns True if the same boxes are stored on the same views, classes aside."""
    known = {view.view_id: view for view in page.view_boxes}
    return all(
        (view := known.get(entry.view)) is not None
        and view.box_kind is entry.box_kind
        and [box.xyxy for box in view.boxes] == [box.xyxy for box in entry.boxes]
        for entry in view_boxes
    )


def _label_uid(page: FramePage, drawn: ObjectDrawn) -> str | None:
    if drawn.uid is not None:
        return label_of(page, drawn.uid).label.uid
    return next((stored.label.uid for stored in page.drawn if stored.image_box == drawn.image_box), None)


def _effort_target(
    page: FramePage, image_boxes: Sequence[Box2D], drawn: ObjectDrawn | None, uid: str | None
) -> str | None:
    """Returns the id that the effort is recorded for: the label's, else that of the unfinished object, else that of the
    only new box on the image."""
    if drawn is not None:
        finished = uid is not None and any(stored.label.uid == uid for stored in page.labels)
        return uid if finished else draft_id(page.frame.id, drawn.image_box)
    before = () if page.image_boxes is None else page.image_boxes.boxes
    new = [box for box in image_boxes if box not in before]
    return draft_id(page.frame.id, new[0]) if len(new) == 1 else None


# Attempts to store a correction while other frames of its track are changed, as by an object that is being followed.
ATTEMPTS = 5


def apply_changes(
    project: Project,
    frame_id: int,
    payloads: Sequence[Payload],
    context: WriteContext,
    open_frame: Callable[[], OpenFrame],
    recordings: OpenRecording | None = None,
) -> int:
    """Stores changes to one frame and the changes they imply, as one action: all or none.

    Args:
        open_frame: returns the frame; called only if finished objects must be remeasured.
        recordings: gives the recording, if boxes move along between other times; None = it is opened.

    Returns:
        The number of unreviewed boxes of corrected boxes' tracks that have moved along (`key_frames`).

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        NotFoundError: no such frame or label.
        FrameError: objects must be remeasured, but the frame cannot be read.
        ProjectError: unknown class.
    """
    return _append(
        project,
        frame_id,
        payloads,
        context,
        lambda page: parts_of(project, page, payloads, context, open_frame),
        recordings,
    )


def _append(
    project: Project,
    frame_id: int,
    payloads: Sequence[Payload],
    context: WriteContext,
    parts: Callable[[FramePage], Sequence[FramePart]],
    recordings: OpenRecording | None,
) -> int:
    """Stores a frame's changes (`parts`) and those that its corrected boxes (in `payloads`) imply in other frames.

    Again if only another frame was changed meanwhile. Returns the number of boxes that have moved along.
    """
    for attempt in range(1, ATTEMPTS + 1):
        # if another change comes between this read and the append, the append refuses the stale revision
        with project.store.snapshot():
            page = read_page(project, frame_id)
            moved, boxes = _in_other_frames(project, page, payloads, context, recordings)
            all_parts = [*parts(page), *moved]
        try:
            project.log.append_to_frames(all_parts)
        except StaleRevisionError:
            is_own = project.frames.get(frame_id).revision != context.revision
            if is_own or not moved or attempt == ATTEMPTS:
                raise
        else:
            break
    return boxes


def parts_of(
    project: Project,
    page: FramePage,
    payloads: Sequence[Payload],
    context: WriteContext,
    open_frame: Callable[[], OpenFrame] | None = None,
) -> list[FramePart]:
    """Changes to one frame, and those that they imply there and on the images of other cameras."""
    if not any(isinstance(entry, ImageBoxesSet | LabelChanged | LabelDeleted) for entry in payloads):
        return [FramePart(page.frame.id, payloads, context)]
    parts = [FramePart(page.frame.id, [*payloads, *_implied(project, page, payloads, open_frame)], context)]
    for other_id, implied in _on_other_images(project, page, payloads):
        revision = parts[-1].context.revision + len(parts[-1].payloads)
        parts.append(FramePart(other_id, implied, replace(context, revision=revision, effort=None)))
    return parts


def parts_of_frames(
    project: Project, changes: Sequence[tuple[StoredFrame, Sequence[Payload]]], context: WriteContext
) -> list[FramePart]:
    """As `parts_of`, of several frames, each at its revision; the first one has the effort.

    Most labels were not drawn on an image. Then a change implies nothing, and the rest of the frame is not read.
    """
    uids = [e.uid for _, events in changes for e in events if isinstance(e, LabelChanged | LabelDeleted)]
    drawn, parts = project.labels.drawn_on_images(uids), list[FramePart]()
    for part, (frame, events) in zip(frame_parts(changes, context), changes, strict=True):
        if drawn and any(isinstance(e, LabelChanged | LabelDeleted) and e.uid in drawn for e in events):
            parts += parts_of(project, read_page(project, frame.id), events, part.context)
        else:
            parts.append(part)
    return parts


def frame_parts(changes: Sequence[tuple[StoredFrame, Sequence[Payload]]], context: WriteContext) -> list[FramePart]:
    """Changes of several frames, each at its revision; the first one has the effort."""
    return [
        FramePart(frame.id, events, replace(context, revision=frame.revision, effort=None if nth else context.effort))
        for nth, (frame, events) in enumerate(changes)
    ]


def _in_other_frames(
    project: Project,
    page: FramePage,
    payloads: Sequence[Payload],
    context: WriteContext,
    recordings: OpenRecording | None,
) -> tuple[list[FramePart], int]:
    """What corrected boxes change in other frames of their tracks; the number of boxes that move along there."""
    before = {stored.label.uid: stored for stored in page.labels}
    by_frame, boxes = defaultdict[StoredFrame, list[Payload]](list), 0
    for entry in payloads:
        if not isinstance(entry, LabelChanged) or entry.box is None or entry.state is not ReviewState.EDITED:
            continue
        stored = before.get(entry.uid)
        is_same = "track_id" not in entry.model_fields_set or (stored and entry.track_id == stored.label.track_id)
        if stored is not None and is_same:
            for frame, events in moved_along(project, page.frame, stored, entry.box.box(), recordings):
                by_frame[frame] += events
                boxes += 1
    return parts_of_frames(project, list(by_frame.items()), replace(context, effort=None)), boxes


def _on_other_images(
    project: Project, page: FramePage, payloads: Sequence[Payload]
) -> Iterator[tuple[int, list[Payload]]]:
    """Yields what changes of labels imply for the images of other cameras from which they were drawn, by frame."""
    uids = {entry.uid for entry in payloads if isinstance(entry, LabelChanged | LabelDeleted)}
    drawn = {each.made_in for each in page.labels if each.label.uid in uids and each.image_box is not None}
    for other_id in sorted(drawn - {page.frame.id}):
        other = read_page(project, other_id)
        if (on_image := image_follower(other, payloads)) is not None:
            yield other_id, [on_image, *view_followers(other, on_image)]


def _implied(
    project: Project, page: FramePage, payloads: Sequence[Payload], open_frame: Callable[[], OpenFrame] | None
) -> list[Payload]:
    on_image = next((entry for entry in reversed(payloads) if isinstance(entry, ImageBoxesSet)), None)
    implied: list[Payload] = []
    if on_image is None:
        on_image = image_follower(page, payloads)
        if on_image is None:
            return implied
        implied.append(on_image)
    implied += view_followers(page, on_image)
    if open_frame is not None and changes_kind(page, on_image):
        opened = open_frame()
        implied += remeasured(page, opened, label_config(project, opened.frame), on_image)
    return implied


def copy_boxes(project: Project, frame_id: int, source_id: int | None, context: WriteContext) -> Receipt:
    """Proposes the reviewed boxes of a frame, as they are, with their track ids and values, as one action.

    A box is left out if the frame has a reviewed box of the same track, or one of its class at its place. Unreviewed
    proposals of the same objects are replaced.

    Args:
        source_id: the frame to copy from; None = the previous one of the recording.

    Raises:
        StaleRevisionError: the frame was changed in the meantime.
        NotFoundError: no such frame.
        ConfigError: the frame is finalised, there is no previous frame, it is the same frame, or it has no box to copy.
    """
    page = read_page(project, frame_id)
    frame = page.frame
    if frame.finalised:
        raise ConfigError("this frame is finalised; reopen it first")
    if source_id is None:
        source_id = page.previous
        if source_id is None:
            raise ConfigError("this is the first frame of its recording; there is no previous one to copy")
    if source_id == frame_id:
        raise ConfigError("a frame cannot be copied into itself")
    project.frames.get(source_id)
    # an object that stands still has its box in the frames that see it
    own = (each.label for each in project.labels.of_moment(source_id) if each.is_own and each.still is None)
    boxes = [label for label in own if label.state in REVIEWED]
    copies = [proposal_like(label, label.box, label.track_id, origin=Origin.COPIED) for label in boxes]
    # the operator asks for them, also where a wrong box was rejected
    payloads = proposal_events(around(project, frame, copies), frame, copies, where_rejected=True)
    if not payloads:
        whys = dict.fromkeys(why_left_out(copy, page.labels) for copy in copies)
        raise ConfigError(f"nothing was copied: {'; '.join(whys) or 'the other frame has no reviewed boxes'}")
    return project.log.append(frame_id, payloads, context)
