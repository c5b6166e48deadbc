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
    """Accepted and edited boxes, and boxes without a review state; others are left out.

    Attributes:
        scored: True if the scores are confidences in 0..1; otherwise they are left out.
    """

    path: Path
    by_frame: Mapping[str, OpenLabelFrame]
    scored: bool

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.by_frame)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        T = None if self.by_frame[name].of_camera else frame.T_camera_label
        return [
            Truth(
                each.label,
                each.box if T is None else each.box.transformed(T),
                each.track_id,
                each.score if self.scored else None,
            )
            for each in self.by_frame[name].boxes
            if _is_imported(each)
        ]

    def left_behind(self, name: str) -> LeftBehind:
        boxes = self.by_frame[name].boxes
        imported = [each for each in boxes if _is_imported(each)]
        lost = 0 if self.scored else sum(each.score is not None for each in imported)
        return LeftBehind(len(boxes) - len(imported), lost)


def _is_imported(box: OpenLabelBox) -> bool:
    return box.state is None or box.state in REVIEWED


def read(path: Path) -> OpenLabelLabels:
    """Raises FormatError: not an OpenLABEL document, or one that does not follow the standard."""
    frames = read_openlabel(path)
    return OpenLabelLabels(path, frames, are_confidences(box.score for each in frames.values() for box in each.boxes))
