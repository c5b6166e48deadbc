"""Which boxes of a frame the reviewed labels cover already."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from annotator.geometry.iou import iou_3d_matrix
from annotator.types import Label, OrientedBox

# Minimum exact 3D IoU at which two boxes count as the same object.
SAME_OBJECT_IOU = 0.5


@runtime_checkable
class Boxed(Protocol):
    """A class name with a 3D box, such as a `Proposal` or a `Label`."""

    @property
    def label(self) -> str:
        """Class name."""

    @property
    def box(self) -> OrientedBox:
        """Camera frame."""


def covered_by(proposals: Sequence[Boxed], reviewed: Iterable[Label]) -> list[str | None]:
    """For each proposal, the uid of the reviewed label of its class with the greatest 3D IoU, if 0.5 or more."""
    covering: list[str | None] = [None] * len(proposals)
    labels = list(reviewed)
    for name in {label.label for label in labels}:
        indices = [index for index, proposal in enumerate(proposals) if proposal.label == name]
        candidates = [label for label in labels if label.label == name]
        if not indices:
            continue
        iou = iou_3d_matrix([proposals[index].box for index in indices], [label.box for label in candidates])
        for index, row in zip(indices, iou, strict=True):
            best = int(np.argmax(row))
            if row[best] >= SAME_OBJECT_IOU:
                covering[index] = candidates[best].uid
    return covering
