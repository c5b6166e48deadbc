"""The JSON of boxes, views, labels and frames, in and out, and its translation from and to annotator's types.

Pixels are continuous and the centre of the first is (0, 0); metres are in the camera frame.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator
from scipy.spatial.transform import Rotation

from annotator.project import Effort as StoredEffort
from annotator.types import Box2D, BoxKind, Camera, OrientedBox, ReviewState, Source

# What a page may send: wide enough for any picture and any recording, and finite.
Px = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Metres = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Length = Annotated[float, Field(ge=1e-4, le=1e4, allow_inf_nan=False)]
Unit = Annotated[float, Field(ge=-1.001, le=1.001, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
ClassName = Annotated[str, StringConstraints(min_length=1, max_length=64)]
Uid = Annotated[str, StringConstraints(min_length=1, max_length=64, pattern=r"^[0-9a-zA-Z_-]+$")]
RowId = Annotated[int, Field(ge=0, le=2**53)]
MOST_BOXES = 1000

Vector3 = tuple[Metres, Metres, Metres]
Unit3 = tuple[Unit, Unit, Unit]
Matrix3 = tuple[Unit3, Unit3, Unit3]
Outline = list[list[list[float]]]


class Wire(BaseModel):
    """What is sent: unknown fields are refused, so that a misspelt one is told and not lost."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Box2DJson(Wire):
    """A box on a picture."""

    label: ClassName
    x_min: Px
    y_min: Px
    x_max: Px
    y_max: Px
    score: Share = 1.0

    @model_validator(mode="after")
    def _has_sides(self) -> Box2DJson:
        if self.x_max <= self.x_min or self.y_max <= self.y_min:
            raise ValueError("x_max and y_max must be greater than x_min and y_min")
        return self

    def box(self) -> Box2D:
        return Box2D(self.label, self.x_min, self.y_min, self.x_max, self.y_max, self.score)


class Box3DJson(Wire):
    """A 3D box; the columns of `rotation` are its axes. A request may give `quaternion` (w, x, y, z) in its place."""

    center: Vector3
    size: tuple[Length, Length, Length]
    rotation: Matrix3 | None = None
    quaternion: tuple[Unit, Unit, Unit, Unit] | None = None

    @model_validator(mode="after")
    def _has_one_rotation(self) -> Box3DJson:
        if (self.rotation is None) == (self.quaternion is None):
            raise ValueError("give either rotation or quaternion")
        if self.quaternion is not None and not 0.5 <= float(np.linalg.norm(self.quaternion)) <= 2:
            raise ValueError("a quaternion must have length 1")
        if self.rotation is not None:
            matrix = np.array(self.rotation)
            if np.abs(matrix.T @ matrix - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
                raise ValueError("rotation must be a rotation matrix (orthonormal, determinant +1)")
        return self

    def box(self) -> OrientedBox:
        if self.quaternion is not None:
            rotation = Rotation.from_quat(self.quaternion, scalar_first=True)
        else:
            rotation = Rotation.from_matrix(np.array(self.rotation))
        return OrientedBox.from_parts(np.array(self.center), rotation.as_matrix(), np.array(self.size))


class Box2DOut(Wire):
    """A box on a picture, as it is kept."""

    label: str
    x_min: float
    y_min: float
    x_max: float
    y_max: float
    score: float

    @classmethod
    def of(cls, box: Box2D) -> Box2DOut:
        return cls.model_construct(
            label=box.label, x_min=box.x_min, y_min=box.y_min, x_max=box.x_max, y_max=box.y_max, score=box.score
        )


class Box3DOut(Wire):
    """A 3D box, as it is kept; the columns of `rotation` are its axes."""

    center: list[float]
    size: list[float]
    rotation: list[list[float]]

    @classmethod
    def of(cls, box: OrientedBox) -> Box3DOut:
        pose = box.T_camera_box.as_matrix()
        return cls.model_construct(
            center=pose[:3, 3].tolist(), size=box.size_m.tolist(), rotation=pose[:3, :3].tolist()
        )


class Effort(Wire):
    """What the operator did since the last answer: counted by the page."""

    actions: Annotated[int, Field(ge=0, le=10_000)]
    seconds: Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)]

    def stored(self) -> StoredEffort:
        return StoredEffort(self.actions, self.seconds)


class ViewJson(Wire):
    """A pseudo-view: a point p lies at px ((axes[0].p - origin_m[0]) / metres_per_px, likewise y with axes[1])."""

    id: str
    url: str
    width: int
    height: int
    axes: list[list[float]]
    metres_per_px: float
    origin_m: list[float]


class QualityJson(Wire):
    """The recursion's signals; null where one had no value."""

    view_disagreement: float | None
    kept_share: float | None
    last_change: float | None
    image_agreement: float | None


class LabelJson(Wire):
    """A 3D label and what is drawn and told of it."""

    uid: str
    label: str
    box: Box3DOut
    score: float | None
    source: Source
    state: ReviewState
    author: str
    time_ns: int
    track_id: int | None
    quality: QualityJson | None
    doubt: float | None
    outline: Outline
    points: int


class FrameJson(Wire):
    """Where a frame is, and its revision."""

    id: int
    recording: int
    recording_name: str
    key: str
    index: int | None
    revision: int
    finalised: bool
    previous: int | None
    next: int | None


class CameraJson(Wire):
    """How the camera sees: a page projects a box while it is dragged; distortion as in `cv2.projectPoints`."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]

    @classmethod
    def of(cls, camera: Camera) -> CameraJson:
        return cls(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, distortion=camera.distortion)


class ImageJson(Wire):
    """The camera image."""

    url: str
    width: int
    height: int
    camera: CameraJson


class ImageBoxesJson(Wire):
    """The boxes on the camera image and what they measure."""

    boxes: list[Box2DOut]
    box_kind: BoxKind


class ObjectJson(Wire):
    """An object begun or finished in Label mode: its image box, the views with the boxes on them, its label's uid."""

    image_box: Box2DOut
    views: list[tuple[ViewJson, Box2DOut | None]]
    uid: str | None


class HistoryJson(Wire):
    """What undo and redo would do next, in words."""

    undo: str | None
    redo: str | None


class FrameStateJson(Wire):
    """All that a page shows of a frame."""

    frame: FrameJson
    image: ImageJson
    up: list[float] | None
    points: int
    image_boxes: ImageBoxesJson | None
    objects: list[ObjectJson]
    labels: list[LabelJson]
    open_by: list[str]
    history: HistoryJson


class FrameRowJson(Wire):
    """One line of the list of frames."""

    id: int
    recording: int
    key: str
    index: int | None
    revision: int
    finalised: bool
    counts: dict[str, int]
    image_boxes: int | None
    doubt: float | None


class FrameListJson(Wire):
    """A part of the list of frames, and how many there are in all."""

    frames: list[FrameRowJson]
    total: int
