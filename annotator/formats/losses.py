"""Counts what a format cannot store of the frames and labels written to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from enum import StrEnum

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.formats.dataset_writing import DatasetItem
from annotator.geometry.transforms import IMAGE_UP
from annotator.types import ReviewState


class Lost(StrEnum):
    """What an export leaves out or approximates.

    TILT: pitch and roll; the nearest upright box was written.
    SCORE, TRACK, STATE: a label's score, track id and review state.
    LENS: lens distortion; image and boxes were written for an ideal pinhole camera.
    DEPTH_COLOR, REFLECTANCE: colours and LiDAR reflectances of points.
    OUTSIDE: objects outside the image, left out because the format needs a 2D box.
    NAME: characters of a class name that the format cannot store.
    TIME: capture times of frames.
    SOLID: 3D boxes; the 2D boxes around their projections were written.
    KIND: the information that 2D boxes enclose whole objects (projected 3D boxes), not only the visible parts.
    SAME: duplicate boxes of one class in a file, and duplicate images.
    OPEN: images with unreviewed proposals, left out.
    GRAVITY: the direction of gravity, where it differs from the image's downward direction.
    LEVEL: gravity is unknown; the format needs it, so the image's downward direction was used.
    UNREADABLE: frames whose files cannot be read, left out on request.
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


# A box with a smaller tilt counts as upright, radians: angles in files are rounded to two to six decimals.
LEAST_TILT_RAD = 1e-3

_WORDS = {
    Lost.TILT: "boxes are tilted; the nearest upright ones were written",
    Lost.SCORE: "boxes have a score",
    Lost.TRACK: "boxes have a track id",
    Lost.STATE: "boxes were not reviewed or were corrected, which the format cannot store",
    Lost.LENS: "frames have lens distortion; images were rectified to an ideal camera",
    Lost.DEPTH_COLOR: "clouds have colours",
    Lost.REFLECTANCE: "clouds have reflectances",
    Lost.OUTSIDE: "boxes are outside the image and were left out",
    Lost.NAME: "boxes have a class name that was written with other characters",
    Lost.TIME: "frames have a capture time",
    Lost.SOLID: "boxes are 3D boxes; the 2D boxes around their projections were written",
    Lost.KIND: "boxes enclose the whole object, not only its visible part; import them with --box-kind box",
    Lost.SAME: "boxes or images are duplicates and were left out",
    Lost.OPEN: "images with reviewed boxes also have unreviewed proposals and were left out",
    Lost.GRAVITY: "frames have a gravity direction other than the image's downward direction",
    Lost.LEVEL: "frames have no known gravity direction; the image's downward direction was used",
    Lost.UNREADABLE: "frames cannot be read and were left out",
}


class Loss(BaseModel):
    """One line of the report.

    Attributes:
        kind: what was lost.
        count: the number of boxes (or frames, or images).
        message: the count and what was lost, as text.
        most: the largest loss where it can be measured: radians for TILT.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Lost
    count: int
    message: str
    most: float | None = None


class Losses:
    """The counters of one export."""

    def __init__(self) -> None:
        self._counts: Counter[Lost] = Counter()
        self._tilt_rad = 0.0

    def add(self, kind: Lost, count: int = 1) -> None:
        """Counts `count` boxes (or frames, or images)."""
        self._counts[kind] += count

    def add_tilt(self, tilt_rad: float) -> None:
        """Counts a box that was written upright, unless its tilt is below `LEAST_TILT_RAD`."""
        if tilt_rad > LEAST_TILT_RAD:
            self._counts[Lost.TILT] += 1
            self._tilt_rad = max(self._tilt_rad, tilt_rad)

    def report(self) -> tuple[Loss, ...]:
        """Returns one line for each kind, in the order of `Lost`."""
        return tuple(self._line(kind) for kind in Lost if self._counts[kind])

    def _line(self, kind: Lost) -> Loss:
        count = self._counts[kind]
        message = f"{count} {_WORDS[kind]}"
        if kind is not Lost.TILT:
            return Loss(kind=kind, count=count, message=message)
        most = f" (by up to {np.rad2deg(self._tilt_rad):.1f} degrees)"
        return Loss(kind=kind, count=count, message=message + most, most=self._tilt_rad)


def count_lost(losses: Losses, item: DatasetItem, kinds: Collection[Lost]) -> None:
    """Counts the losses of one frame and its labels.

    Args:
        kinds: what the format cannot store; only kinds that follow from the frame itself, see `counts` below.
    """
    frame = item.frame
    counts = {
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
        if counts[kind]:
            losses.add(kind, int(counts[kind]))
