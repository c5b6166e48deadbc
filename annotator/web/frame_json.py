"""The JSON of frames, labels and views, and the responses that contain it."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from annotator.project import Project, ViewBoxes
from annotator.project.overview import FrameRow
from annotator.project.records import ViewGeometry
from annotator.types import PseudoView
from annotator.types.errors import RecordingError, StaleRevisionError
from annotator.web.context import Context
from annotator.web.errors import AnsweredError, ErrorBody
from annotator.web.schemas import (
    Box2DOut,
    Box3DOut,
    CameraJson,
    FrameChange,
    FrameJson,
    FrameRowJson,
    FrameStateJson,
    HistoryJson,
    ImageBoxesJson,
    ImageJson,
    LabelJson,
    ObjectJson,
    OtherLabelJson,
    QualityJson,
    SaidJson,
    SuggestionJson,
    ViewJson,
)
from annotator.workflows.detectors import base_titles
from annotator.workflows.frame_source import OtherLabel, Rigs, Sibling
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import ShownFrame, ShownLabel, ShownObject, show_frame, shown_others
from annotator.workflows.workbench.review_queue import doubt

LOG = logging.getLogger("annotator.web")

STALE: dict[int | str, dict[str, Any]] = {
    409: {"description": "The frame has changed since the given revision; the response contains both versions."}
}


class ModelResponse(JSONResponse):
    """A pydantic model as JSON, serialised by pydantic without a second validation.

    For a frame with a hundred boxes, FastAPI's own serialisation takes several times as long.
    """

    def render(self, content: Any) -> bytes:
        model: BaseModel = content
        return model.model_dump_json().encode()


class BothVersions(BaseModel):
    """The response to a stale change: the error, the present state, and the changes of the request."""

    error: ErrorBody
    state: FrameStateJson
    changes: Any


def frame_response(ctx: Context, name: str, frame_id: int, operator: str) -> ModelResponse:
    """The response with the present state of a frame; errors as in `frame_state`."""
    return ModelResponse(frame_state(ctx, name, frame_id, operator))


@contextmanager
def both_versions(ctx: Context, name: str, frame_id: int, operator: str, body: FrameChange) -> Iterator[None]:
    """Within the block, a stale change is answered (409) with both versions of the frame."""
    try:
        yield
    except StaleRevisionError as error:
        why = ErrorBody(kind=type(error).__name__, message=str(error))
        state = frame_state(ctx, name, frame_id, operator)
        both = BothVersions.model_construct(error=why, state=state, changes=body.sent())
        raise AnsweredError(ModelResponse(both, 409)) from error


def frame_state(ctx: Context, name: str, frame_id: int, operator: str) -> FrameStateJson:
    """The present state of a frame for one operator's page."""
    project = ctx.project(name)
    with project.store.snapshot():
        return _frame_state(ctx, name, project, frame_id, operator)


def _frame_state(ctx: Context, name: str, project: Project, frame_id: int, operator: str) -> FrameStateJson:
    opened = ctx.caches.frames.open(project, frame_id, operator)
    shown = show_frame(project, frame_id, opened)
    frame, page = opened.frame, shown.page
    boxes = page.image_boxes
    undo, redo = project.history.next(operator)
    rigs, siblings = _siblings(ctx, project, shown)
    objects, labels = opened.newest(
        "json",
        page.frame.revision,
        lambda: (_objects(name, project, shown.objects, opened), _labels(project, shown.labels, opened)),
    )
    return FrameStateJson.model_construct(
        frame=_frame(shown),
        image=ImageJson(
            url=f"/api/projects/{name}/frames/{frame_id}/image.jpg?v={image_version(project, shown)}{_offset(opened)}",
            width=frame.camera.width_px,
            height=frame.camera.height_px,
            camera=CameraJson.of(frame.camera),
        ),
        up=None if frame.up is None else frame.up.tolist(),
        points=len(frame.cloud),
        image_boxes=None
        if boxes is None
        else ImageBoxesJson(boxes=[Box2DOut.of(box) for box in boxes.boxes], box_kind=boxes.box_kind),
        objects=list(objects.values()),
        labels=list(labels.values()),
        others=_others(shown, opened, rigs.labels_of(siblings)),
        siblings=[each.frame.id for each in siblings],
        open_by=ctx.hub.open_by(name, frame_id, operator),
        history=HistoryJson(undo=undo, redo=redo),
    )


def _siblings(ctx: Context, project: Project, shown: ShownFrame) -> tuple[Rigs, list[Sibling]]:
    """The rig's other cameras; none if one of their recordings cannot be read, as after a move."""
    rigs = ctx.caches.frames.rigs(project)
    try:
        return rigs, rigs.siblings(shown.page.frame)
    except RecordingError as error:
        LOG.warning("the other cameras of %s are not shown: %s", shown.page.recording_name, error)
        return rigs, []


def _others(shown: ShownFrame, opened: OpenFrame, others: Sequence[OtherLabel]) -> list[OtherLabelJson]:
    return [
        OtherLabelJson.model_construct(
            uid=each.other.label.uid,
            label=each.other.label.label,
            state=each.other.label.state,
            track_id=each.other.label.track_id,
            camera=each.other.recording.rpartition("@")[2],
            frame=each.other.frame.id,
            outline=each.outline.round(2).tolist(),
        )
        for each in shown_others(others, shown.page.labels, opened)
    ]


def image_version(project: Project, shown: ShownFrame) -> str:
    """A hash for the image's URL; it differs if another project or recording has taken the same name or id."""
    frame = shown.page.frame
    content = f"{project.config.created_ns} {frame.recording_id} {shown.page.recording_name} {frame.key}"
    return hashlib.sha256(content.encode()).hexdigest()[:12]


def _offset(opened: OpenFrame) -> str:
    """The end of an image's URL, which differs if a time offset shows another image; the page ignores it."""
    return f"&adjusted={opened.adjusted}" if opened.adjusted else ""


def frame_row(row: FrameRow) -> FrameRowJson:
    """One row of the list of frames; its doubt is the highest one of its proposals."""
    doubts = [doubt(stored.quality, stored.label.score) for stored in row.proposed]
    frame = row.frame
    return FrameRowJson(
        id=frame.id,
        recording=frame.recording_id,
        key=frame.key,
        index=frame.index,
        revision=frame.revision,
        finalised=frame.finalised,
        counts={state.value: number for state, number in row.counts.items()},
        image_boxes=row.image_boxes,
        doubt=max((value for value in doubts if value is not None), default=None),
    )


def drawn_view(ctx: Context, name: str, view: PseudoView, picture: bytes) -> ViewJson:
    """The JSON of a new pseudo-view; its image (PNG) is cached, and stored once a box is drawn on it."""
    height, width = view.rgb.shape[:2]
    return _view(name, ctx.caches.view_images.add(picture), (width, height), view)


def _view(name: str, view_id: str, size: tuple[int, int], geometry: PseudoView | ViewGeometry) -> ViewJson:
    return ViewJson(
        id=view_id,
        url=f"/api/projects/{name}/views/{view_id}.png",
        width=size[0],
        height=size[1],
        axes=np.asarray(geometry.axes).tolist(),
        metres_per_px=geometry.metres_per_px,
        origin_m=np.asarray(geometry.origin_m).tolist(),
    )


def _frame(shown: ShownFrame) -> FrameJson:
    frame = shown.page.frame
    return FrameJson(
        id=frame.id,
        recording=frame.recording_id,
        recording_name=shown.page.recording_name,
        key=frame.key,
        index=frame.index,
        revision=frame.revision,
        finalised=frame.finalised,
        previous=shown.page.previous,
        next=shown.page.next,
        attributes=dict(shown.page.attributes),
    )


# What the JSON of a label depends on: the label, the name of what measured it, and whether it is kept.
_Facts = tuple[ShownLabel, str | None, bool]


def _labels(project: Project, shown: Sequence[ShownLabel], opened: OpenFrame) -> dict[_Facts, LabelJson]:
    run_ids = {label.stored.run_id for label in shown} - {None}
    measured_by = base_titles(project) if run_ids else {}
    # most frames have none, and need no query
    may_be_kept = {each.stored.frame_id for each in shown if each.stored.label.attributes}
    kept = frozenset[str]().union(*(project.labels.kept(frame_id) for frame_id in may_be_kept))
    # only those that have changed are converted anew
    before: dict[_Facts, LabelJson] = (opened.latest("json") or ((), {}))[1]
    facts = [(each, measured_by.get(each.stored.run_id or 0), each.stored.label.uid in kept) for each in shown]
    return {each: before.get(each) or _label(*each) for each in facts}


def _label(shown: ShownLabel, measured_by: str | None, kept: bool) -> LabelJson:
    label = shown.stored.label
    return LabelJson.model_construct(
        uid=label.uid,
        label=label.label,
        box=Box3DOut.of(label.box),
        score=label.score,
        source=label.source,
        state=label.state,
        author=label.author,
        time_ns=label.time_ns,
        track_id=label.track_id,
        quality=QualityJson.of(shown.stored.quality),
        doubt=shown.doubt,
        measured_by=measured_by,
        suggestion=None if label.suggestion is None else SuggestionJson.of(label.suggestion),
        said=[SaidJson(source=each.source, label=each.label, score=each.score) for each in shown.stored.said],
        box_kind=label.box_kind,
        attributes=dict(label.attributes),
        kept=kept,
        outline=shown.outline.round(2).tolist(),
        points=shown.points,
    )


def _objects(
    name: str, project: Project, shown: Sequence[ShownObject], opened: OpenFrame
) -> dict[Hashable, ObjectJson]:
    """The drawn objects; only those that have changed are converted anew."""
    before: dict[Hashable, ObjectJson] = (opened.latest("json") or ({},))[0]
    facts = {
        (name, each.image_box, tuple((view.event_id, view.boxes) for view in each.views), each.uid): each
        for each in shown
    }
    return {key: before.get(key) or _object(name, project, each) for key, each in facts.items()}


def _object(name: str, project: Project, drawn: ShownObject) -> ObjectJson:
    return ObjectJson(
        image_box=Box2DOut.of(drawn.image_box),
        views=[(_stored_view(name, project, view), Box2DOut.of(view.boxes[0])) for view in drawn.views],
        uid=drawn.uid,
    )


def _stored_view(name: str, project: Project, view: ViewBoxes) -> ViewJson:
    assert view.geometry is not None  # guaranteed by `views_by_object`
    return _view(name, view.view_id, project.views.size(view.view_id), view.geometry)
