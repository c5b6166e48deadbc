"""Labels of an `rcv` dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.formats.rcv import read_rcv
from annotator.project import REVIEWED
from annotator.types import Frame, Label, Truth
from annotator.workflows.importing.label_set import LeftBehind


@dataclass(frozen=True)
class RcvLabels:
    """Accepted and edited labels; proposals and rejected boxes are left out."""

    path: Path
    labels: dict[str, tuple[Label, ...]]

    @property
    def frames(self) -> Sequence[str]:
        return tuple(self.labels)

    def truths(self, name: str, frame: Frame) -> list[Truth]:
        reviewed = (label for label in self.labels[name] if label.state in REVIEWED)
        return [Truth(label.label, label.box, label.track_id, label.score) for label in reviewed]

    def left_behind(self, name: str) -> LeftBehind:
        return LeftBehind(not_reviewed=sum(label.state not in REVIEWED for label in self.labels[name]))


def read(path: Path) -> RcvLabels:
    """Raises FormatError: not an `rcv` dataset, or a label file that does not follow the format."""
    dataset = read_rcv(path)
    return RcvLabels(path, dict(dataset.named_labels(i) for i in range(len(dataset))))
