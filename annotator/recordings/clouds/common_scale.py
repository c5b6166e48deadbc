"""One scale of reflectance, and one of colours, for all scans of a recording.

Many files do not say whether their values are fractions, 8 or 16 bits, and a dark scan looks like one of a smaller
scale. The first scans of a recording decide for all.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from itertools import islice
from pathlib import Path
from typing import TypeVar

from annotator.recordings.clouds.columns import RawCloud, Scales
from annotator.types.errors import FrameError

FIRST = 3

Source = TypeVar("Source")


class CommonScale:
    """The scales of the places from which scans come: folders, topics."""

    def __init__(self) -> None:
        self._found: dict[Hashable, Scales] = {}

    def apply(
        self, place: Hashable, raw: RawCloud, scans: Callable[[], Iterable[Source]], read: Callable[[Source], RawCloud]
    ) -> RawCloud:
        """Returns a scan with the scales of its place, or its own, if its values are larger.

        Args:
            scans: returns the scans of the place, in a fixed order.
            read: reads one of them; ValueError and FrameError = it is damaged, which its own frame tells.
        """
        if not any(raw.scales):
            return raw
        if place not in self._found:
            scales = [found for scan in islice(scans(), FIRST) if any(found := _scales_of(read, scan))]
            if not scales:
                return raw
            self._found[place] = (max(each for each, _ in scales), max(each for _, each in scales))
        return raw.with_scales(self._found[place])


def files_like(path: Path) -> list[Path]:
    """Returns the files of a folder with the suffix of this one, by name."""
    return sorted(file for file in path.parent.iterdir() if file.suffix.lower() == path.suffix.lower())


def _scales_of(read: Callable[[Source], RawCloud], scan: Source) -> Scales:
    try:
        return read(scan).scales
    except (FrameError, ValueError):
        return 0.0, 0.0
