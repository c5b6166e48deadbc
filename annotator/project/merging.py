"""One proposal for each object, from the boxes of several sources."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from annotator.geometry.iou import intersection_volume_pairs, iou_3d_matrix
from annotator.project.log.records import OWN, SaidRecord
from annotator.types import Label, OrientedBox

# TODO-MERGED docstring of covering.py:
# Which boxes of a frame the reviewed labels cover already.


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


Group = tuple[SaidRecord, ...]
"""What the sources say of one object; the first box is the one to show."""


def merged(said: Sequence[SaidRecord]) -> list[Group]:
    """Returns one group for each object, with at most one box of each source; two boxes of a source stay apart.

    Boxes of two sources are one object if their exact 3D IoU is 0.5 or more, whatever their classes. The surest box is
    shown. A box without a score counts as sure. If two are equally sure, it is that of the other software, since
    somebody wants to see it; otherwise the earlier one.
    """
    if len({each.source for each in said}) <= 1:
        return [(each,) for each in said]
    ranked = sorted(said, key=lambda each: (-_certainty(each), each.source == OWN))
    overlaps = _overlaps(ranked)
    groups: list[list[int]] = []
    for index, each in enumerate(ranked):
        free = [group for group in groups if each.source not in {ranked[other].source for other in group}]
        best = max(free, key=lambda group: overlaps.get((group[0], index), 0.0), default=None)
        if best is not None and overlaps.get((best[0], index), 0.0) >= SAME_OBJECT_IOU:
            best.append(index)
        else:
            groups.append([index])
    return [tuple(ranked[index] for index in group) for group in groups]


def _overlaps(said: Sequence[SaidRecord]) -> dict[tuple[int, int], float]:
    """The IoU of the boxes of different sources that may touch, by the indices of both, the smaller one first."""
    centers, sizes = np.array([each.box.center_m for each in said]), np.array([each.box.size_m for each in said])
    rotations = np.array([each.box.rotation for each in said])
    reach = np.linalg.norm(sizes, axis=1) / 2
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    names = np.array([each.source for each in said])
    near = (apart < reach[:, None] + reach) & (names[:, None] != names)
    first, second = np.nonzero(np.triu(near))
    if len(first) == 0:
        return {}
    parts = (values[chosen] for chosen in (first, second) for values in (centers, rotations, sizes))
    shared, volumes = intersection_volume_pairs(*parts), sizes.prod(axis=1)
    iou = shared / (volumes[first] + volumes[second] - shared)
    return dict(zip(zip(first.tolist(), second.tolist(), strict=True), iou.tolist(), strict=True))


def _certainty(said: SaidRecord) -> float:
    return 1.0 if said.score is None else said.score
