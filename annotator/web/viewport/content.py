"""What a viewport shall show, in the words of the project; `scene.py` makes it a picture."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from jaxtyping import Float64

from annotator.types import Box2D, Frame, OrientedBox, PseudoView, ReviewState

# Shown at most: what a graphics card turns without effort, and a network carries at once.
MOST_POINTS = 150_000


class Gizmo(StrEnum):
    """What can be done with the selected box in the viewport."""

    OFF = "off"
    TRANSLATE = "translate"
    ROTATE = "rotate"


class PointColor(StrEnum):
    """What the colour of a point stands for."""

    RGB = "rgb"
    DEPTH = "depth"
    HEIGHT = "height"
    INTENSITY = "intensity"


@dataclass(frozen=True, eq=False)
class ShownBox:
    """A 3D box of the scene.

    Attributes:
        uid: of its label; None for a box that is no label yet.
        box: camera frame.
        state: decides its colour.
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
        box: what the drags so far measure, camera frame.
    """

    image_box: Box2D
    views: tuple[PseudoView, ...]
    box: OrientedBox | None


@dataclass(frozen=True, eq=False)
class SceneContent:
    """All that a viewport shows.

    Attributes:
        place: which recording this is; another one gets a new first view.
        frame: None shows nothing.
        selected: uid of the selected box.
        draft: the object that is being labelled, if any.
        most_points: shown of the cloud; the full cloud stays on the server.
        point_size: 1 is what suits the recording's distances; a factor of that.
        reset_view: go back to the first view.
    """

    place: tuple[str, int] | None
    frame: Frame | None
    boxes: tuple[ShownBox, ...] = ()
    selected: str | None = None
    gizmo: Gizmo = Gizmo.OFF
    draft: Draft | None = None
    color: PointColor = PointColor.RGB
    most_points: int = MOST_POINTS
    point_size: float = 1.0
    reset_view: bool = False


@dataclass(frozen=True, eq=False)
class FirstView:
    """Where the viewer stands first, in the camera frame, metres.

    Attributes:
        position, look_at: of the viewer.
        up: unit vector that is up on the screen.
    """

    position: Float64[np.ndarray, "3"]
    look_at: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]
