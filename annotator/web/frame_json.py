"""The JSON of a frame with its labels and views, and the responses that contain it."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from fastapi import Depends
from fastapi.responses import JSONResponse
from pydantic import BaseModel

from annotator.geometry.outline import visible_edges
from annotator.project import Project, ViewBoxes
from annotator.project.overview import FramePage, read_page
from annotator.project.records import ViewGeometry
from annotator.types import OrientedBox, PseudoView
from annotator.types.errors import StaleRevisionError
from annotator.web.context import Ctx, InProject, Operator
from annotator.web.errors import AnsweredError, ErrorBody
from annotator.web.schemas import (
    Box2DJson,
    Box3DJson,
    CameraJson,
    FrameChange,
    FrameJson,
    FrameStateJson,
    HistoryJson,
    ImageBoxesJson,
    ImageJson,
    LabelJson,
    ObjectJson,
    QualityJson,
    RowId,
    SaidJson,
    ViewJson,
)
from annotator.workflows.detectors import base_titles
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.frame_state import ShownObject, Sight, shown_objects, sights
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


@dataclass(eq=False)
class InFrame(InProject):
    """A request about a frame."""

    frame_id: int

    def open(self) -> OpenFrame:
        return self.ctx.caches.frames.open(self.project, self.frame_id, self.operator)

    def state(self, best_for: str | None = None) -> FrameStateJson:
        """The present state of the frame for the operator's page.

        Args:
            best_for: uid of a label; if another camera of the moment sees it much better, the state of its frame.
        """
        with self.project.store.snapshot():
            state = _state(self)
        better = next((label.better_in for label in state.labels if label.uid == best_for), None)
        return state if better is None else replace(self, frame_id=better).state()

    @contextmanager
    def change(self, body: FrameChange) -> Iterator[None]:
        """Within the block, the change is stored; then the pages are told. A stale one is answered (409) with both
        versions of the frame.
        """
        try:
            yield
        except StaleRevisionError as error:
            why = ErrorBody(kind=type(error).__name__, message=str(error))
            both = BothVersions.model_construct(error=why, state=self.state(), changes=body.sent())
            raise AnsweredError(ModelResponse(both, 409)) from error
        self.announce()


async def _in_frame(ctx: Ctx, name: str, frame_id: RowId, operator: Operator) -> InFrame:
    return InFrame(ctx, name, operator, frame_id)


AtFrame = Annotated[InFrame, Depends(_in_frame)]


def _state(at: InFrame) -> FrameStateJson:
    project, opened = at.project, at.open()
    frame, page = opened.frame, read_page(project, at.frame_id)
    boxes = page.image_boxes
    undo, redo = project.history.next(at.operator)
    version = picture_version(project, page.frame.recording_id, page.recording_name, page.frame.key, opened.adjusted)
    return FrameStateJson.model_construct(
        frame=FrameJson.of(
            page.frame,
            recording=page.frame.recording_id,
            recording_name=page.recording_name,
            previous=page.previous,
            next=page.next,
            cameras=dict(page.cameras),
            T_camera_cloud=None if page.T_camera_cloud is None else page.T_camera_cloud.as_matrix().tolist(),
            attributes=dict(page.attributes),
        ),
        image=ImageJson(
            url=f"/api/projects/{at.name}/frames/{at.frame_id}/image.jpg?{version}",
            width=frame.camera.width_px,
            height=frame.camera.height_px,
            camera=CameraJson.of(frame.camera),
        ),
        up=None if frame.up is None else frame.up.tolist(),
        points=len(frame.cloud),
        image_boxes=None
        if boxes is None
        else ImageBoxesJson(boxes=[Box2DJson.of(box) for box in boxes.boxes], box_kind=boxes.box_kind),
        objects=[_object(at.name, project, each) for each in shown_objects(page)],
        labels=_labels(at, page, opened),
        open_by=at.ctx.hub.open_by(at.name, at.frame_id, at.operator),
        history=HistoryJson(undo=undo, redo=redo),
    )


def picture_version(project: Project, recording_id: int, name: str, key: str, adjusted: int) -> str:
    """The query of a picture's address, by which browsers may cache it; with the key "" of all pictures of a recording.

    Differs if another project or recording has taken the same name or id.
    """
    place = f"{project.config.created_ns} {recording_id} {name} {key}"
    # a time offset shows another image; the page ignores this
    offset = f"&adjusted={adjusted}" if adjusted else ""
    return f"v={hashlib.sha256(place.encode()).hexdigest()[:12]}{offset}"


def drawn_view(at: InProject, view: PseudoView, picture: bytes) -> ViewJson:
    """The JSON of a new pseudo-view; its image (PNG) is cached, and stored once a box is drawn on it."""
    height, width = view.rgb.shape[:2]
    view_id = hashlib.sha256(picture).hexdigest()
    at.ctx.caches.view_images.get(view_id, lambda: picture)
    return _view(at.name, view_id, (width, height), view)


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


def _labels(at: InFrame, page: FramePage, opened: OpenFrame) -> list[LabelJson]:
    project = at.project
    measured_by = base_titles(project) if {stored.run_id for stored in page.labels} - {None} else {}
    # most frames have none, and need no query
    may_be_kept = next((stored.frame_id for stored in page.labels if stored.label.attributes), None)
    kept = frozenset[str]() if may_be_kept is None else project.labels.kept(may_be_kept)
    is_tracked = any(stored.label.track_id is not None for stored in page.labels)
    beside = project.labels.beside(page.frame) if is_tracked else {}
    seen = sights(project, at.ctx.caches.frames, page)
    outlines = visible_edges(opened.frame.camera, [stored.label.box for stored in page.labels])
    return [
        LabelJson.of(
            stored.label,
            box=Box3DJson.of(stored.label.box),
            quality=QualityJson.of(stored.quality),
            doubt=doubt(stored.quality, stored.label.score),
            measured_by=measured_by.get(stored.run_id or 0),
            said=[SaidJson.of(said) for said in stored.said],
            attributes=dict(stored.label.attributes),
            kept=stored.label.uid in kept,
            heading_beside=_heading(beside.get(stored.label.track_id)),
            outline=outline.round(2).tolist(),
            points=opened.points_in(stored.label.box),
            seen_by=seen.get(stored.label.uid, Sight()).frames,
            better_in=seen.get(stored.label.uid, Sight()).better,
            still=stored.still is not None,
        )
        for stored, outline in zip(page.labels, outlines, strict=True)
    ]


def _heading(box: OrientedBox | None) -> list[float] | None:
    return None if box is None else box.rotation[:, 0].tolist()


def _object(name: str, project: Project, drawn: ShownObject) -> ObjectJson:
    return ObjectJson.of(
        drawn,
        image_box=Box2DJson.of(drawn.image_box),
        views=[(_stored_view(name, project, view), Box2DJson.of(view.boxes[0])) for view in drawn.views],
    )


def _stored_view(name: str, project: Project, view: ViewBoxes) -> ViewJson:
    assert view.geometry is not None  # guaranteed by `views_by_object`
    return _view(name, view.view_id, project.views.size(view.view_id), view.geometry)
