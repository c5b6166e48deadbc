"""Counts what a format cannot store of the frames and labels written to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import StrEnum

import numpy as np
from pydantic import BaseModel, ConfigDict

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox
from annotator.types.messages import amount


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
    KIND: the information that some 2D boxes of an image are projected 3D boxes, where the others are drawn around what
        is seen.
    SAME: duplicate boxes of one class in a file, and duplicate images.
    OPEN: images with unreviewed proposals, left out.
    GRAVITY: the direction of gravity, where it differs from the image's downward direction.
    LEVEL: gravity is unknown; the format needs it, so the image's downward direction was used.
    ROUNDED: digits of a box that the format's rounding drops.
    CUT: points of a scan outside the camera's view.
    ATTRIBUTE: values of attributes.
    SAID: what sources of boxes, such as detectors, said of objects before the review.
    ORIGIN: the place of the camera in map coordinates; boxes and points were written relative to the camera.
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
    ROUNDED = "rounded"
    CUT = "cut"
    ATTRIBUTE = "attribute"
    SAID = "said"
    ORIGIN = "origin"
    UNREADABLE = "unreadable"


# Corners that move less are unchanged, metres.
LEAST_ROUNDING_M = 1e-6
# A box with a smaller tilt counts as upright, radians: angles in files are rounded to two to six decimals.
LEAST_TILT_RAD = 1e-3

# What is counted: {for one|for several} and the rest of the line.
_WORDS = {
    Lost.TILT: "{box is tilted; the nearest upright one was|boxes are tilted; the nearest upright ones were} written",
    Lost.SCORE: "{box has|boxes have} a score",
    Lost.TRACK: "{box has|boxes have} a track id",
    Lost.STATE: (
        "{box was not reviewed or was|boxes were not reviewed or were} corrected, which the format cannot store"
    ),
    Lost.LENS: "{frame has|frames have} lens distortion; images were rectified to an ideal camera",
    Lost.DEPTH_COLOR: "{cloud has|clouds have} colours",
    Lost.REFLECTANCE: "{cloud has|clouds have} reflectances",
    Lost.OUTSIDE: "{box is outside the image and was|boxes are outside the image and were} left out",
    Lost.NAME: "{box has|boxes have} a class name that was written with other characters",
    Lost.TIME: "{frame has|frames have} a capture time",
    Lost.SOLID: (
        "{box is a 3D box; the 2D box around its projection was|boxes are 3D boxes; the 2D boxes around their "
        "projections were} written"
    ),
    Lost.KIND: (
        "{box is a projected 3D box|boxes are projected 3D boxes} on images whose other boxes are drawn around what is "
        "seen"
    ),
    Lost.SAME: "{box or image is a duplicate and was|boxes or images are duplicates and were} left out",
    Lost.OPEN: (
        "{image with reviewed boxes also has unreviewed proposals and was|images with reviewed boxes also have "
        "unreviewed proposals and were} left out"
    ),
    Lost.GRAVITY: "{frame has|frames have} a gravity direction other than the image's downward direction",
    Lost.LEVEL: "{frame has|frames have} no known gravity direction; the image's downward direction was used",
    Lost.ROUNDED: "{box was|boxes were} rounded",
    Lost.CUT: "{frame has|frames have} a scan with points outside the camera's view, which were left out",
    Lost.ATTRIBUTE: "{attribute value|attribute values} cannot be stored in this format",
    Lost.SAID: "{box was|boxes were} proposed by other software; this format cannot store which one",
    Lost.ORIGIN: "{frame has|frames have} a place in a map; boxes and points were written relative to the camera",
    Lost.UNREADABLE: "{frame cannot be read and was|frames cannot be read and were} left out",
}


class Loss(BaseModel):
    """One line of the report.

    Attributes:
        kind: what was lost.
        count: the number of boxes (or frames, or images).
        message: the count and what was lost, as text.
        most: the largest loss where it can be measured: radians for TILT; metres, of a corner, for ROUNDED.
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
        self._tilt_rad = self._rounding_m = 0.0
        self._values: Counter[str] = Counter()

    def add(self, kind: Lost, count: int = 1) -> None:
        """Counts `count` boxes (or frames, or images)."""
        self._counts[kind] += count

    def add_values(self, names: Iterable[str]) -> None:
        """Counts values of attributes, each by the attribute's name."""
        before = self._values.total()
        self._values.update(list(names))  # a mapping would count by its values
        self.add(Lost.ATTRIBUTE, self._values.total() - before)

    def add_tilt(self, tilt_rad: float) -> None:
        """Counts a box that was written upright, unless its tilt is below `LEAST_TILT_RAD`."""
        if tilt_rad > LEAST_TILT_RAD:
            self._counts[Lost.TILT] += 1
            self._tilt_rad = max(self._tilt_rad, tilt_rad)

    def add_rounding(self, before: OrientedBox, after: OrientedBox) -> None:
        """Counts a box that was rounded, unless its corners move by less than `LEAST_ROUNDING_M`."""
        moved_m = float(np.linalg.norm(box_corners(after) - box_corners(before), axis=1).max())
        if moved_m > LEAST_ROUNDING_M:
            self._counts[Lost.ROUNDED] += 1
            self._rounding_m = max(self._rounding_m, moved_m)

    def report(self) -> tuple[Loss, ...]:
        """Returns one line for each kind, in the order of `Lost`."""
        return tuple(self._line(kind) for kind in Lost if self._counts[kind])

    def _line(self, kind: Lost) -> Loss:
        count = self._counts[kind]
        several, rest = _WORDS[kind][1:].split("} ", 1)
        message, most = f"{amount(count, *several.split('|'))} {rest}", None
        if kind is Lost.ROUNDED:
            message, most = f"{message} (corners move by up to {self._rounding_m * 1000:.2g} mm)", self._rounding_m
        elif kind is Lost.TILT:
            message, most = f"{message} (by up to {np.rad2deg(self._tilt_rad):.1f} degrees)", self._tilt_rad
        elif kind is Lost.ATTRIBUTE:
            message += f" ({', '.join(f'{number} {name}' for name, number in sorted(self._values.items()))})"
        return Loss(kind=kind, count=count, message=message, most=most)
