"""Alignment mode: the cloud over the image, the correction of the calibration, and the up direction."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from fastapi import APIRouter
from fastapi.responses import Response
from pydantic import Field

from annotator.geometry.projection import thin
from annotator.project import Basis, StoredFrame
from annotator.recordings.clouds.virtual_camera import has_virtual_image
from annotator.recordings.frame_times import has_times, recorded_times
from annotator.types import Correction
from annotator.types.frame import MOST_OFFSET_S, MOST_SHIFT_M
from annotator.web.context import AtProject, Ctx, InProject
from annotator.web.frame_json import AtFrame
from annotator.web.schemas import CameraJson, RowId, Schema, Unit3, WithEffort
from annotator.workflows.recorded.adjusting import correct_calibration, estimate_recording_up
from annotator.workflows.workbench.frame_cache import OpenFrame

router = APIRouter(tags=["alignment"])

MOST_POINTS = 15_000
# Images that are offered: 30 seconds before and after at 30 Hz, some 90 kB of JSON.
MOST_IMAGES = 2000

# as `Correction` allows them
Degrees = Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-MOST_SHIFT_M, le=MOST_SHIFT_M, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=-MOST_OFFSET_S, le=MOST_OFFSET_S, allow_inf_nan=False)]


class CorrectionJson(Schema):
    """A correction: a rotation vector in degrees, a shift in metres, the lead of the clouds' clock in seconds."""

    turn_deg: tuple[Degrees, Degrees, Degrees]
    shift_m: tuple[Metres, Metres, Metres]
    time_offset_s: Seconds

    def correction(self) -> Correction:
        x, y, z = np.radians(self.turn_deg).tolist()
        return Correction((x, y, z), self.shift_m, self.time_offset_s)


class ImageAt(Schema):
    """An image that a time offset may show; `seconds`: its time after the frame's own."""

    frame: int
    seconds: float


class AlignmentJson(Schema):
    """How a frame's cloud lies on its image.

    `points`: x, y, z of some points one after the other, metres, in the camera frame without the correction.
    `up`: unit vector in the corrected camera frame. `adjusted` identifies the present correction and up direction.
    `labels` and `drawn_images`: number of 3D boxes, and of images with drawn boxes, in the recording. `is_virtual`: the
    image is drawn from the cloud, so there is no calibration to correct.
    """

    recording: int
    name: str
    adjusted: int
    camera: CameraJson
    width: int
    height: int
    points: list[float]
    correction: CorrectionJson
    up: tuple[float, ...] | None
    up_source: Literal["unknown", "files", "project"]
    images: list[ImageAt]
    labels: int
    drawn_images: int
    is_virtual: bool


class EstimatedUp(Schema):
    """An estimated up direction with its certainty (0 to 1), or the reason why there is none."""

    up: tuple[float, ...] | None
    certainty: float
    spread_deg: float
    frames: int
    agreeing: int
    reason: str


class Adjusting(WithEffort):
    """The frame on screen, and the `adjusted` of the recording that the change is based on."""

    frame: RowId
    adjusted: RowId

    def basis(self) -> Basis:
        return Basis(self.adjusted, self.frame, self.stored_effort())


class UpIn(Adjusting):
    """The up direction in the corrected camera frame; null = as the recording's files give it."""

    up: Unit3 | None


class CorrectionIn(Adjusting):
    """The whole correction; zeros remove it."""

    correction: CorrectionJson


@router.get("/api/projects/{name}/frames/{frame_id}/alignment")
def show(at: AtFrame) -> AlignmentJson:
    """How the frame's cloud lies on its image."""
    return _alignment(at, at.frame_id)


@router.get("/api/projects/{name}/frames/{frame_id}/recorded.jpg", response_class=Response)
def recorded_image(ctx: Ctx, name: str, frame_id: RowId) -> Response:
    """The frame's own image, without a time offset."""
    opened = OpenFrame(ctx.caches.frames.recorded(ctx.project(name), frame_id))
    return Response(opened.jpeg, media_type="image/jpeg", headers={"Cache-Control": "no-cache"})


@router.post("/api/projects/{name}/recordings/{recording}/estimate-up")
def estimate_up(at: AtProject, recording: RowId) -> EstimatedUp:
    """Estimate the up direction from some of the recording's frames. Nothing is stored."""
    found = estimate_recording_up(at.project, recording)
    return EstimatedUp.of(found, spread_deg=float(np.degrees(found.spread_rad)))


@router.post("/api/projects/{name}/recordings/{recording}/up")
def set_up(at: AtProject, recording: RowId, body: UpIn) -> AlignmentJson:
    """Set the recording's up direction. Stored boxes do not change."""
    at.project.adjustments.set_up(recording, body.up, at.operator, body.basis())
    return _adjusted(at, body.frame)


@router.post("/api/projects/{name}/recordings/{recording}/correction")
def correct(at: AtProject, recording: RowId, body: CorrectionIn) -> AlignmentJson:
    """Correct the recording's calibration. 3D boxes and pseudo-views stay where they are in the clouds."""
    correct_calibration(at.project, recording, body.correction.correction(), at.operator, body.basis())
    return _adjusted(at, body.frame)


def _adjusted(at: InProject, frame_id: int) -> AlignmentJson:
    at.announce()
    return _alignment(at, frame_id)


def _alignment(at: InProject, frame_id: int) -> AlignmentJson:
    project, cache = at.project, at.ctx.caches.frames
    stored = project.frames.get(frame_id)
    recording = project.recordings.get(stored.recording_id)
    recorded, up = cache.recorded(project, frame_id), cache.read(project, frame_id).up
    keep = thin(len(recorded.cloud), MOST_POINTS)
    xyz_m = recorded.cloud.xyz_m if keep is None else recorded.cloud.xyz_m[keep]
    correction = recording.correction
    return AlignmentJson.model_construct(
        recording=recording.id,
        name=recording.name,
        adjusted=recording.adjusted,
        camera=CameraJson.of(recorded.camera),
        width=recorded.camera.width_px,
        height=recorded.camera.height_px,
        points=xyz_m.astype(np.float64).round(4).ravel().tolist(),
        correction=CorrectionJson.model_construct(
            turn_deg=tuple(np.degrees(correction.turn_rad).tolist()),
            shift_m=correction.shift_m,
            time_offset_s=correction.time_offset_s,
        ),
        up=None if up is None else tuple(up.tolist()),
        up_source="unknown" if up is None else "files" if recording.up is None else "project",
        images=_images(at, stored),
        labels=project.labels.count(recordings=[recording.id]),
        drawn_images=len(project.boxes.on_images([recording.id])),
        is_virtual=has_virtual_image(recorded),
    )


def _images(at: InProject, stored: StoredFrame) -> list[ImageAt]:
    """The frames whose images a time offset may show, nearest times first."""
    recording = at.ctx.caches.frames.recording(at.project, stored.recording_id)
    times = (recorded_times(recording) if has_times(recording) else None) or {}
    now = times.get(stored.key)
    if now is None:
        return []
    frames = [(frame, times.get(frame.key)) for frame in at.project.frames.of([stored.recording_id])]
    apart = [(each.id, (time - now) / 1e9) for each, time in frames if each.index is not None and time is not None]
    nearest = sorted(apart, key=lambda each: abs(each[1]))[:MOST_IMAGES]
    return [ImageAt(frame=frame, seconds=seconds) for frame, seconds in nearest]
