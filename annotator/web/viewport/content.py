"""The content of a viewport, as data; `scene.py` draws it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64

from annotator.types import Box2D, Frame, OrientedBox, PseudoView, ReviewState

# Default limit of shown points, which graphics cards and networks handle without delay.
MOST_POINTS = 150_000


class Gizmo(StrEnum):
    """The mode of the gizmo on the selected box."""

    OFF = "off"
    TRANSLATE = "translate"
    ROTATE = "rotate"


class PointColor(StrEnum):
    """The quantity that the points' colours show."""

    RGB = "rgb"
    DEPTH = "depth"
    HEIGHT = "height"
    INTENSITY = "intensity"


@dataclass(frozen=True, eq=False)
class ShownBox:
    """A 3D box of the scene.

    Attributes:
        uid: of its label; None for a box without a label.
        box: camera frame.
        state: determines its colour.
    """

    uid: str | None
    box: OrientedBox
    state: ReviewState


@dataclass(frozen=True, eq=False)
class Draft:
    """An object that is being labelled.

    Attributes:
        image_box: on the camera image.
        views: the pseudo-views of the present step.
        box: the 3D box from the 2D boxes drawn so far, camera frame.
    """

    image_box: Box2D
    views: tuple[PseudoView, ...]
    box: OrientedBox | None


@dataclass(frozen=True, eq=False)
class SceneContent:
    """The content of a viewport.

    Attributes:
        key: identifies the recording; the camera is reset if it changes.
        frame: None = an empty viewport.
        selected: uid of the selected box.
        draft: the object that is being labelled, if any.
        most_points: maximum number of shown points; a larger cloud is thinned.
        point_size: factor of the default size, which depends on the cloud's distance.
        reset_camera: move the camera to its initial pose.
    """

    key: tuple[str, int] | None
    frame: Frame | None
    boxes: tuple[ShownBox, ...] = ()
    selected: str | None = None
    gizmo: Gizmo = Gizmo.OFF
    draft: Draft | None = None
    color: PointColor = PointColor.RGB
    most_points: int = MOST_POINTS
    point_size: float = 1.0
    reset_camera: bool = False


@dataclass(frozen=True, eq=False)
class InitialCamera:
    """The initial pose of the viewport's camera, in the camera frame, metres.

    Attributes:
        position: of the camera.
        look_at: the point at the centre of the screen.
        up: unit vector that points up on the screen.
    """

    position: Float64[np.ndarray, "3"]
    look_at: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]
