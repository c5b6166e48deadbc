"""Labels of nuScenes tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.nuscenes import NuScenesBox, read_nuscenes
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftBehind


@dataclass(frozen=True)
class NuScenesLabels:
    """The annotations of every camera's images."""

    path: Path
    by_frame: Mapping[str, tuple[NuScenesBox, ...]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        return [Truth(each.label, each.box, each.track_id) for each in self.by_frame[name]]

    def left_behind(self, name: str) -> LeftBehind:
        return LeftBehind()


def read(path: Path) -> NuScenesLabels:
    """Raises FormatError: no nuScenes tables, or rows that do not follow the schema."""
    return NuScenesLabels(path, read_nuscenes(path))
