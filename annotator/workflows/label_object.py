"""Keeping what an operator has drawn of an object: everything that is new, as one action."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from dataclasses import dataclass, replace

from annotator.project import Change, Origin, Project, Receipt, StoredLabel, ViewBoxes
from annotator.project.efforts import draft_id
from annotator.project.overview import FramePage, read_page
from annotator.project.payloads import (
    ImageBoxesSet,
    LabelCreated,
    LabelEdited,
    Payload,
    ViewBoxesSet,
)
from annotator.project.records import BoxRecord
from annotator.types import Box2D, BoxKind
from annotator.types.errors import ConfigError, NotFoundError, StaleRevisionError
from annotator.workflows.detectors_ready import ReadyDetector
from annotator.workflows.labelling import VIEWS_A_STEP, Boxes, Labelling, label_config, label_steps
from annotator.workflows.open_frame import OpenFrame
from annotator.workflows.remeasure import remeasured, same_box
from annotator.workflows.view_followers import changes_kind, view_followers
from annotator.workflows.views_out import geometry_of


@dataclass(frozen=True)
class ObjectDrawn:
    """An object as far as it is drawn.

    Attributes:
        image_box: on the camera image.
        boxes: on its views, as `label_steps` takes them.
        uid: of the label that it has become already, or None.
    """

    image_box: Box2D
    boxes: Boxes
    uid: str | None = None


@dataclass(frozen=True)
class Saved:
    """What was kept: the receipt (None where nothing was new), and the uid of the object's label, if it is finished."""

    receipt: Receipt | None
    uid: str | None


def save_object(
    project: Project,
    frame_id: int,
    opened: OpenFrame,
    image_boxes: Sequence[Box2D],
    kind: BoxKind,
    drawn: ObjectDrawn | None,
    change: Change,
) -> Saved:
    """Keeps the boxes on the image, those on an object's views and, with all four, its 3D label: all or none.

    Boxes on views whose image box is gone, and on views that another box on an earlier step has replaced, go too: what
    they show is no step of any object.

    Args:
        image_boxes: all of the image, the object's among them.
        kind: what the boxes measure.

    Raises:
        StaleRevisionError: somebody has changed the frame since.
        NotFoundError: no such frame or label.
        ConfigError: the object's image box is not among those of the image; or more than four boxes.
        ProjectError: a class that the project does not have.
    """
    page = read_page(project, frame_id)
    if page.frame.revision != change.revision:
        where = f"frame {page.frame.key} of recording {page.recording_name}"
        raise StaleRevisionError(where, change.revision, page.frame.revision)
    if drawn is not None and drawn.image_box not in image_boxes:
        raise ConfigError("the object's image_box is not among image_boxes; send all boxes of the image")
    on_image = ImageBoxesSet(boxes=tuple(image_boxes), box_kind=kind)
    payloads: list[Payload] = []
    if page.image_boxes is None or (page.image_boxes.boxes, page.image_boxes.box_kind) != (on_image.boxes, kind):
        payloads.append(on_image)
    uid = None
    wanted: list[ViewBoxesSet] = []
    if drawn is not None:
        config = label_config(project, opened.frame)
        labelling = label_steps(opened, drawn.image_box, drawn.boxes, config, kind)
        wanted = _view_boxes(project, page, drawn, kind, labelling)
        label = _label_change(page, drawn, labelling, wanted)
        uid = _linked(page, drawn) if label is None else label.uid
        payloads += _new_views(page, wanted) + ([] if label is None else [label])
    redrawn = None if drawn is None else drawn.image_box
    payloads += view_followers(page, on_image, redrawn=redrawn, kept={entry.view for entry in wanted})
    if changes_kind(page, on_image):
        others = remeasured(page, opened, label_config(project, opened.frame), on_image)
        payloads += [entry for entry in others if entry.uid != uid]
    if not payloads:
        return Saved(None, uid)
    subject = change.subject or _subject(page, image_boxes, drawn, uid)
    return Saved(project.log.append(frame_id, payloads, replace(change, subject=subject)), uid)


def suggested_image_boxes(
    opened: OpenFrame, detector: ReadyDetector, least_score: float, classes: Sequence[str]
) -> list[Box2D]:
    """What the image detector finds on a frame, of the project's classes, best first."""
    found = opened.image_detections(detector)
    return [box for box in found if box.score >= least_score and box.label in classes]


def _view_boxes(
    project: Project, page: FramePage, drawn: ObjectDrawn, kind: BoxKind, labelling: Labelling
) -> list[ViewBoxesSet]:
    """The boxes of an object on the views that its earlier boxes have led to.

    A view that came from 3D boxes shows other objects, too: the object's own box is the first, and theirs stay.
    """
    known = {view.view_id: view.boxes[1:] for view in page.view_boxes if view.box_kind is kind}
    found = []
    for place, (view, box) in enumerate(zip(labelling.views, drawn.boxes, strict=False)):
        if box is None:
            continue
        view_id = project.views.store(view.rgb)
        boxes, geometry = (box, *known.get(view_id, ())), geometry_of(view, drawn.image_box)
        found.append(
            ViewBoxesSet(view=view_id, boxes=boxes, box_kind=kind, step=place // VIEWS_A_STEP, geometry=geometry)
        )
    return found


def _new_views(page: FramePage, wanted: Sequence[ViewBoxesSet]) -> list[Payload]:
    known = {view.view_id: view for view in page.view_boxes}
    return [entry for entry in wanted if not _is_kept(known.get(entry.view), entry)]


def _is_kept(view: ViewBoxes | None, entry: ViewBoxesSet) -> bool:
    return view is not None and (view.boxes, view.box_kind, view.step, view.geometry) == (
        entry.boxes,
        entry.box_kind,
        entry.step,
        entry.geometry,
    )


def _label_change(
    page: FramePage, drawn: ObjectDrawn, labelling: Labelling, wanted: Sequence[ViewBoxesSet]
) -> LabelCreated | LabelEdited | None:
    """The object's 3D label, where all four boxes are there, or it is there already and not as it should be.

    The box that the same drags have led to before may have been corrected since: only other drags lead to another. As
    long as some of these are missing the label keeps its box, and goes with its image box.
    """
    is_complete = len(labelling.views) == len(drawn.boxes) == 2 * VIEWS_A_STEP and None not in drawn.boxes
    measured = labelling.box if is_complete else None
    name, uid = drawn.image_box.label, _linked(page, drawn)
    if uid is not None:
        present = _label(page, uid)
        box = present.label.box if measured is None or _are_drawn(page, wanted) else measured
        if present.image_box == drawn.image_box and present.label.label == name and same_box(present.label.box, box):
            return None
        track = present.label.track_id
        return LabelEdited(uid=uid, label=name, box=BoxRecord.of(box), track_id=track, image_box=drawn.image_box)
    if measured is None:
        return None
    new = uuid.uuid4().hex
    return LabelCreated(uid=new, label=name, box=BoxRecord.of(measured), origin=Origin.DRAWN, image_box=drawn.image_box)


def _are_drawn(page: FramePage, wanted: Sequence[ViewBoxesSet]) -> bool:
    """True where the same edges are on the same views already, whatever their class."""
    known = {view.view_id: view for view in page.view_boxes}
    return all(
        (view := known.get(entry.view)) is not None
        and view.box_kind is entry.box_kind
        and [box.xyxy for box in view.boxes] == [box.xyxy for box in entry.boxes]
        for entry in wanted
    )


def _linked(page: FramePage, drawn: ObjectDrawn) -> str | None:
    if drawn.uid is not None:
        return _label(page, drawn.uid).label.uid
    return next((stored.label.uid for stored in page.labels if stored.image_box == drawn.image_box), None)


def _label(page: FramePage, uid: str) -> StoredLabel:
    found = next((stored for stored in page.labels if stored.label.uid == uid), None)
    if found is None:
        raise NotFoundError(f"frame {page.frame.key} has no label {uid} (any more); reload the frame")
    return found


def _subject(page: FramePage, image_boxes: Sequence[Box2D], drawn: ObjectDrawn | None, uid: str | None) -> str | None:
    """What the effort went into: the label, else the begun object, else the one box on the image that is new."""
    if drawn is not None:
        finished = uid is not None and any(stored.label.uid == uid for stored in page.labels)
        return uid if finished else draft_id(page.frame.id, drawn.image_box)
    before = () if page.image_boxes is None else page.image_boxes.boxes
    new = [box for box in image_boxes if box not in before]
    return draft_id(page.frame.id, new[0]) if len(new) == 1 else None
