"""Labels of OpenLABEL documents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.openlabel import OpenLabelFrame, read_openlabel
from annotator.project import REVIEWED
from annotator.types import Frame, Truth


@dataclass(frozen=True)
class OpenLabelLabels:
    """The boxes that somebody has accepted or edited, and all of documents that do not say; the others stay behind."""

    path: Path
    found: Mapping[str, OpenLabelFrame]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.found)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        T = None if self.found[name].of_camera else frame.T_camera_label
        return [
            Truth(each.label, each.box if T is None else each.box.transformed(T), each.track_id)
            for each in self.found[name].boxes
            if each.state is None or each.state in REVIEWED
        ]


def read(path: Path) -> OpenLabelLabels:
    """Raises FormatError: no OpenLABEL, or a document that does not follow the standard."""
    return OpenLabelLabels(path, read_openlabel(path))
