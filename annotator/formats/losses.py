"""What a format could not hold of the labels that were written in it, counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from enum import StrEnum

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.formats.dataset import DatasetItem
from annotator.geometry.level import IMAGE_UP
from annotator.types import ReviewState


class Lost(StrEnum):
    """What is missing from a dataset, or stands there only nearly.

    TILT: pitch and roll; the nearest upright box was written.
    SCORE, TRACK, STATE: the label's score, its track id, its state in the review.
    LENS: the lens's distortion; image and boxes were written for an ideal pinhole camera.
    DEPTH_COLOR, REFLECTANCE: the colours of points, and how much of the LiDAR's light they return.
    OUTSIDE: objects that are not in the picture, left out where the format needs a 2D box.
    NAME: characters of a class name that the format cannot hold.
    TIME: when frames were taken.
    SOLID: 3D boxes, of which their outlines on the image were written.
    KIND: that 2D boxes are those of 3D boxes, and not of what is seen of the objects.
    SAME: boxes that a file cannot tell from others of their class, and pictures that are there already.
    OPEN: images whose objects nobody has reviewed to the end, left out.
    GRAVITY: the direction of gravity, where it is not the image's downwards.
    LEVEL: gravity was not known; where the format needs it, the image's downwards was taken for it.
    UNREADABLE: frames whose files cannot be read, left out because somebody asked for it.
    """

    TILT = "tilt"
    SCORE = "score"
    TRACK = "track"
    STATE = "state"
    LENS = "lens"
    DEPTH_COLOR = "point_color"
    REFLECTANCE = "reflectance"
    OUTSIDE = "outside"
    NAME = "name"
    TIME = "time"
    SOLID = "solid"
    KIND = "kind"
    SAME = "same"
    OPEN = "open"
    GRAVITY = "gravity"
    LEVEL = "level"
    UNREADABLE = "unreadable"


# A box that leans by less is upright, radians: angles in files have two to six decimals.
LEAST_TILT_RAD = 1e-3

_WORDS = {
    Lost.TILT: "boxes are tilted; the nearest upright ones were written",
    Lost.SCORE: "boxes have a score",
    Lost.TRACK: "boxes have a track id",
    Lost.STATE: "boxes were not reviewed or were corrected, which the format cannot say",
    Lost.LENS: "frames have a lens distortion; images were straightened for an ideal camera",
    Lost.DEPTH_COLOR: "clouds have colours",
    Lost.REFLECTANCE: "clouds have reflectances",
    Lost.OUTSIDE: "boxes are not in the picture and were left out",
    Lost.NAME: "boxes have a class name that was written with other characters",
    Lost.TIME: "frames have a time",
    Lost.SOLID: "boxes are 3D boxes; their outlines on the image were written",
    Lost.KIND: "boxes reach around all of the object, not only around what is seen; import them with --kind box",
    Lost.SAME: "boxes (or pictures) are the same as another one, and were left out",
    Lost.OPEN: "images with reviewed boxes also have proposals that wait for a review, and were left out",
    Lost.GRAVITY: "frames know where gravity points, and it is not down the image",
    Lost.LEVEL: "frames do not know where gravity points; it was taken to point down the image",
    Lost.UNREADABLE: "frames cannot be read, and were left out",
}


class Loss(BaseModel):
    """One line of the report.

    Attributes:
        kind: of what.
        count: how many boxes (or frames).
        message: for a person.
        most: the largest loss, where it can be measured: radians for TILT.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Lost
    count: int
    message: str
    most: float | None = None


class Losses:
    """Counts while a dataset is written."""

    def __init__(self) -> None:
        self._counts: Counter[Lost] = Counter()
        self._tilt_rad = 0.0

    def add(self, kind: Lost, count: int = 1) -> None:
        """So many boxes (or frames) lost this."""
        self._counts[kind] += count

    def add_tilt(self, tilt_rad: float) -> None:
        """A box was written upright that leans by so much, if it does."""
        if tilt_rad > LEAST_TILT_RAD:
            self._counts[Lost.TILT] += 1
            self._tilt_rad = max(self._tilt_rad, tilt_rad)

    def report(self) -> tuple[Loss, ...]:
        """One line a kind, in the order of `Lost`."""
        return tuple(self._line(kind) for kind in Lost if self._counts[kind])

    def _line(self, kind: Lost) -> Loss:
        count = self._counts[kind]
        message = f"{count} {_WORDS[kind]}"
        if kind is not Lost.TILT:
            return Loss(kind=kind, count=count, message=message)
        most = f" (by up to {np.rad2deg(self._tilt_rad):.1f} degrees)"
        return Loss(kind=kind, count=count, message=message + most, most=self._tilt_rad)


def count_lost(losses: Losses, item: DatasetItem, kinds: Collection[Lost]) -> None:
    """Counts what one frame and its labels have of `kinds`.

    Args:
        kinds: what the format does not hold, of those that a frame tells before it is written.
    """
    frame = item.frame
    has = {
        Lost.LENS: not frame.camera.is_ideal,
        Lost.DEPTH_COLOR: frame.cloud.rgb is not None,
        Lost.REFLECTANCE: frame.cloud.reflectance is not None,
        Lost.TIME: frame.timestamp_ns is not None,
        Lost.GRAVITY: frame.up is not None and float(np.linalg.norm(frame.up - IMAGE_UP)) > LEAST_TILT_RAD,
        Lost.SCORE: sum(label.score is not None for label in item.labels),
        Lost.TRACK: sum(label.track_id is not None for label in item.labels),
        Lost.STATE: sum(label.state is not ReviewState.ACCEPTED for label in item.labels),
    }
    for kind in kinds:
        if has[kind]:
            losses.add(kind, int(has[kind]))
