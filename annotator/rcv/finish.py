"""From the ends of a frame's recursions to its proposals: scores, quality, and which of rival boxes stay."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from annotator.geometry.fit import aligned_box
from annotator.geometry.nms import nms_3d
from annotator.geometry.outline import box_on_image, points_on_image
from annotator.rcv.axes import camera_frame
from annotator.rcv.canonical import canonical_box
from annotator.rcv.config import RcvConfig
from annotator.rcv.cross_view import box_iou
from annotator.rcv.recursion import ObjectState
from annotator.types import BoxKind, Camera, Frame, LostObject, OrientedBox, Proposal, StopReason


@dataclass(frozen=True, eq=False)
class FrameProposals:
    """What one frame gave: boxes, best first, and the frustums that led to none."""

    key: str
    proposals: tuple[Proposal, ...]
    lost: tuple[LostObject, ...]


def finish(frame: Frame, states: Sequence[ObjectState], config: RcvConfig) -> FrameProposals:
    """What a frame's recursions have led to, all of them ended.

    Of boxes that overlap, and of further objects in one frustum, the agreement with the image decides who stays: a
    part of a neighbour that reaches into a frustum is seen whole, and better, from its own.
    """
    proposals: list[Proposal] = []
    lost: list[LostObject] = []
    for state in states:
        box = _final_box(state, config)
        if box is None:
            lost.append(LostObject(state.image_box.label, state.image_box, state.steps))
            continue
        # No view has confirmed the box around a frustum: it ranks below all that one has.
        score = float(np.sqrt(state.image_box.score * (state.view_score or config.min_view_score)))
        quality = replace(state.quality, image_agreement=image_agreement(frame.camera, state, box, config))
        proposals.append(Proposal(state.image_box.label, score, box, state.image_box, state.steps, quality))
    proposals = _without_strangers(proposals, config)
    rank = np.array([p.score * _agreement(p) for p in proposals])
    keep = nms_3d([p.box for p in proposals], rank, [p.label for p in proposals], config.nms_iou)
    kept = sorted((proposals[int(i)] for i in keep), key=lambda p: -p.score)
    return FrameProposals(frame.key, tuple(kept), tuple(lost))


def image_agreement(camera: Camera, state: ObjectState, box: OrientedBox, config: RcvConfig) -> float:
    """IoU on the image: what an object's 3D box (for silhouettes, its points) spans, with the box it came from."""
    label = state.image_box.label
    if config.box_kind is BoxKind.SILHOUETTE:
        seen = points_on_image(camera, state.cloud.xyz_m, label)
    else:
        seen = box_on_image(camera, box, label)
    return 0.0 if seen is None else box_iou(seen, state.image_box)


def _final_box(state: ObjectState, config: RcvConfig) -> OrientedBox | None:
    if state.stop not in (StopReason.LOST, StopReason.TOO_FEW_POINTS):
        return state.box
    return _coarse_box(state, config) if config.coarse_box else None


def _coarse_box(state: ObjectState, config: RcvConfig) -> OrientedBox | None:
    """The last box of an object that got lost, or the one around its frustum's points (RCV paper, section II.B)."""
    if state.box is not None:
        return state.box
    if len(state.cloud) < config.min_points:
        return None
    return canonical_box(aligned_box(state.cloud.xyz_m, camera_frame(state.up).T), state.up)


def _without_strangers(proposals: Iterable[Proposal], config: RcvConfig) -> list[Proposal]:
    """Of each frustum the object that agrees best with its image box, and the others that agree well enough."""
    by_frustum: dict[int, list[Proposal]] = defaultdict(list)
    for proposal in proposals:
        by_frustum[id(proposal.image_box)].append(proposal)
    kept: list[Proposal] = []
    for found in by_frustum.values():
        best = max(found, key=_agreement)
        kept += [p for p in found if p is best or _agreement(p) >= config.min_image_agreement]
    return kept


def _agreement(proposal: Proposal) -> float:
    return proposal.quality.image_agreement or 0.0
