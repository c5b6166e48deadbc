"""Labels of OpenLABEL documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.openlabel import OpenLabelBox, OpenLabelFrame, read_openlabel
from annotator.project import REVIEWED
from annotator.types import Frame, Truth
from annotator.workflows.importing.label_set import LeftBehind, are_confidences


@dataclass(frozen=True)
class OpenLabelLabels:
    """The boxes that somebody has accepted or edited, and all of documents that do not say; the others stay behind.

    Attributes:
        scored: the objects' scores are confidences in 0..1; otherwise they stay behind, too.
    """

    path: Path
    found: Mapping[str, OpenLabelFrame]
    scored: bool

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.found)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        T = None if self.found[name].of_camera else frame.T_camera_label
        return [
            Truth(
                each.label,
                each.box if T is None else each.box.transformed(T),
                each.track_id,
                each.score if self.scored else None,
            )
            for each in self.found[name].boxes
            if _comes_along(each)
        ]

    def left_behind(self, name: str) -> LeftBehind:
        boxes = self.found[name].boxes
        along = [each for each in boxes if _comes_along(each)]
        lost = 0 if self.scored else sum(each.score is not None for each in along)
        return LeftBehind(len(boxes) - len(along), lost)


def _comes_along(box: OpenLabelBox) -> bool:
    return box.state is None or box.state in REVIEWED


def read(path: Path) -> OpenLabelLabels:
    """Raises FormatError: no OpenLABEL, or a document that does not follow the standard."""
    found = read_openlabel(path)
    return OpenLabelLabels(path, found, are_confidences(box.score for each in found.values() for box in each.boxes))
