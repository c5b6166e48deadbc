"""Schemas of the JSON of boxes, views, labels and frames, and their conversion from and to annotator's types.

Pixel coordinates are continuous, (0, 0) is the centre of the first pixel; metres are in the camera frame.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, StringConstraints, model_validator
from scipy.spatial.transform import Rotation

from annotator.geometry.projection import radius_limit_squared
from annotator.project import Effort as StoredEffort
from annotator.project import WriteContext
from annotator.project.classes.attributes import Value
from annotator.project.records import Rotation3, ViewGeometry
from annotator.types import Box2D, BoxKind, Camera, OrientedBox, Quality, ReviewState, Source, Suggestion
from annotator.types.bases import Strict, TrackId

# Limits of numbers in requests: finite, and wide enough for any image and recording.
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


def _rotation_matrix(rows: Matrix3) -> Matrix3:
    matrix = np.array(rows)
    if np.abs(matrix.T @ matrix - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise ValueError("must be a rotation matrix (orthonormal, determinant +1)")
    return rows


Axes = Annotated[Matrix3, AfterValidator(_rotation_matrix)]


class Schema(Strict):
    """Base of all schemas; unknown fields are refused, so that a misspelt one causes an error."""

    @classmethod
    def of(cls, source: object, /, **more: Any) -> Self:
        """From an object with attributes of the same names; `more` has the other fields. Nothing is validated."""
        same = {name: getattr(source, name) for name in cls.model_fields if name not in more}
        return cls.model_construct(**same, **more)  # type: ignore[return-value]  # its plugin for mypy knows no `Self`


class Box2DJson(Schema):
    """A box on an image."""

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


class ImageBoxIn(Schema):
    """A drawn object, by its box on the image."""

    image_box: Box2DJson


class Box3DJson(Schema):
    """A 3D box; the columns of `rotation` are its axes."""

    center: Vector3
    size: tuple[Length, Length, Length]
    rotation: Axes

    def box(self) -> OrientedBox:
        rotation = Rotation.from_matrix(np.array(self.rotation)).as_matrix()
        return OrientedBox.from_parts(np.array(self.center), rotation, np.array(self.size))

    @classmethod
    def of(cls, source: object, /, **more: Any) -> Self:
        """From an `OrientedBox`; nothing is validated."""
        assert isinstance(source, OrientedBox)
        center, size = tuple(source.pose[:3, 3].tolist()), tuple(source.size_m.tolist())
        rotation = tuple(map(tuple, source.pose[:3, :3].tolist()))
        return super().of(source, center=center, size=size, rotation=rotation, **more)


class PlaneJson(Schema):
    """The plane of a pseudo-view, as in `ViewJson`."""

    axes: Rotation3
    # of a small object on a large view, less than any length
    metres_per_px: Annotated[float, Field(gt=0, le=1e4, allow_inf_nan=False)]
    origin_m: tuple[Metres, Metres]

    def geometry(self) -> ViewGeometry:
        return ViewGeometry.model_validate(self.model_dump())


Planes = Annotated[tuple[PlaneJson | None, ...], Field(max_length=4)]


class Effort(Schema):
    """The operator's effort since the last acknowledged change, as counted by the page."""

    actions: Annotated[int, Field(ge=0, le=10_000)]
    seconds: Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)]


class WithEffort(Schema):
    """A change, and what it took the operator."""

    effort: Effort | None = None

    def stored_effort(self) -> StoredEffort | None:
        return None if self.effort is None else StoredEffort(self.effort.actions, self.effort.seconds)


class FrameChange(WithEffort):
    """A change of a frame, based on one revision of it."""

    revision: RowId

    def context(self, author: str, target: str | None = None) -> WriteContext:
        """The context of the change; `target`: uid of the label that the effort is for."""
        return WriteContext(self.revision, author, effort=self.stored_effort(), effort_target=target)

    def sent(self) -> list[Any]:
        """The changes as the page has sent them, for the answer to a stale one."""
        return [self.model_dump(mode="json", by_alias=True)]


class ViewJson(Schema):
    """A pseudo-view: point p has the pixel x = (axes[0].p - origin_m[0]) / metres_per_px, y likewise with axes[1]."""

    id: str
    url: str
    width: int
    height: int
    axes: list[list[float]]
    metres_per_px: float
    origin_m: list[float]


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


Signal = Annotated[float | None, BeforeValidator(_finite)]


class QualityJson(BaseModel):
    """The recursion's signals; null if a signal has no value."""

    model_config = ConfigDict(from_attributes=True, frozen=True)

    view_disagreement: Signal
    kept_share: Signal
    last_change: Signal
    expected_iou_loss: Signal

    @classmethod
    def of(cls, quality: Quality | None) -> QualityJson | None:
        return None if quality is None else cls.model_validate(quality)


class SaidJson(Schema):
    """What other software, or another person, says of an object: its class, and the certainty in 0..1 if known."""

    source: str
    label: str
    score: float | None


class LabelValues(Schema):
    """What an operator says of an object: its class, its 3D box and its track."""

    label: ClassName
    box: Box3DJson
    track_id: TrackId | None = None


class LabelJson(LabelValues):
    """A 3D label with its outline on the image, its number of points and its doubt.

    `measured_by` names the base detector if it measured the proposal; `box_kind` is what the box encloses; `kept`: a
    proposal that passes of the detectors do not replace, because a person has set values of it; `heading_beside`: the
    heading of the box before it in its track, or else after it, as a unit vector. `seen_by`: the frames of the cameras
    of a rig that see it, the best first; `better_in`: where it is seen, if this camera sees it not, or much worse;
    `still`: it stands still, and has one box in all frames.
    """

    uid: str
    score: float | None
    source: Source
    state: ReviewState
    author: str
    quality: QualityJson | None
    doubt: float | None
    measured_by: str | None
    suggestion: Suggestion | None
    said: list[SaidJson]
    box_kind: BoxKind
    attributes: dict[str, Value]
    kept: bool
    heading_beside: list[float] | None
    outline: Outline
    points: int
    seen_by: tuple[int, ...]
    better_in: int | None
    still: bool


class FrameJson(Schema):
    """A frame: its recording, key, index, neighbours, revision, and values of its own attributes.

    `cameras`: the frames of its moment, its own included, by the ids of their recordings. `T_camera_cloud`: if there
    are several, from the frame of their cloud to that of this camera (4 x 4); null: they are the same.
    """

    id: int
    recording: int
    recording_name: str
    key: str
    index: int | None
    revision: int
    finalised: bool
    previous: int | None
    next: int | None
    cameras: dict[int, int]
    T_camera_cloud: list[list[float]] | None
    attributes: dict[str, Value]


class CameraJson(Schema):
    """Camera intrinsics, with which the page projects a dragged box; distortion as in `cv2.projectPoints`.

    `most_q`: the squared distance from the axis, at depth 1, up to which the lens model counts; null: everywhere.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...]
    most_q: float | None

    @classmethod
    def of(cls, source: object, /, **more: Any) -> Self:
        """From a `Camera`; nothing is validated."""
        assert isinstance(source, Camera)
        limit = radius_limit_squared(source.distortion)
        return super().of(source, most_q=limit if math.isfinite(limit) else None, **more)


class ImageJson(Schema):
    """The camera image."""

    url: str
    width: int
    height: int
    camera: CameraJson


class ImageBoxesJson(Schema):
    """The boxes on the camera image, and what they enclose."""

    boxes: list[Box2DJson]
    box_kind: BoxKind


class ObjectJson(Schema):
    """An object drawn on pseudo-views: its image box, the views with their boxes, and its label's uid once finished."""

    image_box: Box2DJson
    views: list[tuple[ViewJson, Box2DJson | None]]
    uid: str | None


class HistoryJson(Schema):
    """Descriptions of the next undo and redo."""

    undo: str | None
    redo: str | None


class FrameStateJson(Schema):
    """All data of a frame that the page shows. `labels`: of its moment, also those that its image does not show."""

    frame: FrameJson
    image: ImageJson
    up: list[float] | None
    points: int
    image_boxes: ImageBoxesJson | None
    objects: list[ObjectJson]
    labels: list[LabelJson]
    open_by: list[str]
    history: HistoryJson
