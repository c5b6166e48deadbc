"""Counts what a format cannot store of the frames and labels written to it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from enum import StrEnum

import numpy as np

from annotator.geometry.oriented_box import box_corners
from annotator.types import OrientedBox
from annotator.types.bases import Strict
from annotator.types.messages import amount


class Lost(StrEnum):
    """What an export leaves out or approximates; in words, {for one|for several} and the rest of the line."""

    words: str

    def __new__(cls, value: str, words: str) -> Lost:
        member = str.__new__(cls, value)
        member._value_, member.words = value, words
        return member

    TILT = (
        "tilt",
        "{box is tilted; the nearest upright one was|boxes are tilted; the nearest upright ones were} written",
    )
    SCORE = "score", "{box has|boxes have} a score"
    TRACK = "track", "{box has|boxes have} a track id"
    STATE = (
        "state",
        "{box was not reviewed or was|boxes were not reviewed or were} corrected, which the format cannot store",
    )
    LENS = "lens", "{frame has|frames have} lens distortion; images were rectified to an ideal camera"
    DEPTH_COLOR = "point_color", "{cloud has|clouds have} colours"
    REFLECTANCE = "reflectance", "{cloud has|clouds have} reflectances"
    OUTSIDE = "outside", "{box is outside the image and was|boxes are outside the image and were} left out"
    NAME = "name", "{box has|boxes have} a class name that was written with other characters"
    TIME = "time", "{frame has|frames have} a capture time"
    SOLID = (
        "solid",
        "{box is a 3D box; the 2D box around its projection was|boxes are 3D boxes; the 2D boxes around their "
        "projections were} written",
    )
    KIND = (
        "kind",
        "{box is a projected 3D box|boxes are projected 3D boxes} on images whose other boxes are drawn around what is "
        "seen",
    )
    SAME = "same", "{box or image is a duplicate and was|boxes or images are duplicates and were} left out"
    OPEN = (
        "open",
        "{image with reviewed boxes also has unreviewed proposals and was|images with reviewed boxes also have "
        "unreviewed proposals and were} left out",
    )
    GRAVITY = "gravity", "{frame has|frames have} a gravity direction other than the image's downward direction"
    LEVEL = "level", "{frame has|frames have} no known gravity direction; the image's downward direction was used"
    ROUNDED = "rounded", "{box was|boxes were} rounded"
    CUT = "cut", "{frame has|frames have} a scan with points outside the camera's view, which were left out"
    ATTRIBUTE = "attribute", "{attribute value|attribute values} cannot be stored in this format"
    SAID = "said", "{box was|boxes were} proposed by other software; this format cannot store which one"
    ORIGIN = "origin", "{frame has|frames have} a place in a map; boxes and points were written relative to the camera"
    UNREADABLE = "unreadable", "{frame cannot be read and was|frames cannot be read and were} left out"


# Corners that move less are unchanged, metres.
LEAST_ROUNDING_M = 1e-6
# A box with a smaller tilt counts as upright, radians: angles in files are rounded to two to six decimals.
LEAST_TILT_RAD = 1e-3


class Loss(Strict):
    """One line of the report.

    Attributes:
        kind: what was lost.
        count: the number of boxes (or frames, or images).
        message: the count and what was lost, as text.
        most: the largest loss where it can be measured: radians for TILT; metres, of a corner, for ROUNDED.
    """

    kind: Lost
    count: int
    message: str
    most: float | None = None


class Losses:
    """The counters of one export."""

    def __init__(self) -> None:
        self._counts: Counter[Lost] = Counter()
        self._most: dict[Lost, float] = {}
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
        self._add_beyond(Lost.TILT, tilt_rad, LEAST_TILT_RAD)

    def add_rounding(self, before: OrientedBox, after: OrientedBox) -> None:
        """Counts a box that was rounded, unless its corners move by less than `LEAST_ROUNDING_M`."""
        moved_m = float(np.linalg.norm(box_corners(after) - box_corners(before), axis=1).max())
        self._add_beyond(Lost.ROUNDED, moved_m, LEAST_ROUNDING_M)

    def _add_beyond(self, kind: Lost, value: float, least: float) -> None:
        if value > least:
            self.add(kind)
            self._most[kind] = max(self._most.get(kind, 0.0), value)

    def report(self) -> tuple[Loss, ...]:
        """Returns one line for each kind, in the order of `Lost`."""
        return tuple(self._line(kind) for kind in Lost if self._counts[kind])

    def _line(self, kind: Lost) -> Loss:
        count, most = self._counts[kind], self._most.get(kind)
        several, rest = kind.words[1:].split("} ", 1)
        message = f"{amount(count, *several.split('|'))} {rest}"
        if most is not None:
            said = f"corners move by up to {most * 1000:.2g} mm" if kind is Lost.ROUNDED else ""
            message += f" ({said or f'by up to {np.rad2deg(most):.1f} degrees'})"
        elif kind is Lost.ATTRIBUTE:
            message += f" ({', '.join(f'{number} {name}' for name, number in sorted(self._values.items()))})"
        return Loss(kind=kind, count=count, message=message, most=most)
