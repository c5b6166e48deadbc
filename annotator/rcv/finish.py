"""The proposals of a frame from its finished recursions: scores, quality, and removal of duplicates."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from annotator.geometry.iou import box_iou, iou_3d_matrix, nms_3d
from annotator.geometry.oriented_box import aligned_box, canonical_box, contains
from annotator.geometry.outline import box_on_image, points_on_image
from annotator.rcv.axes import camera_axes
from annotator.rcv.config import MIN_POINTS, RcvConfig
from annotator.rcv.first_look import expected_outline, known_edges
from annotator.rcv.recursion import FrustumFacts, ObjectState
from annotator.rcv.typical_size import Candidates, best_expected, changed
from annotator.types import BoxKind, Camera, Frame, LostObject, OrientedBox, Proposal, StopReason

# Of boxes of a class with a higher IoU, only the better one is kept.
NMS_IOU = 0.3
# Margin within which points of the image box's middle count as inside a rival, share of its mean side.
MIDDLE_MARGIN = 0.03
# How many times each rival's box is changed, and how much (`typical_size.changed`).
CHANGES, CHANGE_SCALE = 20, 0.5
# How much the IoU with the box of another object of the frame lowers a candidate's score.
OVERLAP_WEIGHT = 2.0
# Least IoU with the image box for further objects in a frustum.
MIN_IMAGE_AGREEMENT = 0.05


@dataclass(frozen=True, eq=False)
class FrameProposals:
    """The result of one frame: proposals, best first, and the objects for which no box was found."""

    key: str
    proposals: tuple[Proposal, ...]
    lost: tuple[LostObject, ...]


def finish(frame: Frame, states: Sequence[ObjectState], config: RcvConfig) -> FrameProposals:
    """The proposals of a frame whose recursions have all ended.

    The agreement with the image box decides among overlapping boxes and among several objects in one frustum. A
    neighbour that is partly inside a frustum is completely inside its own, so its box there agrees better.
    """
    proposals: list[Proposal] = []
    lost: list[LostObject] = []
    for state in best_rivals(frame.camera, states, config):
        box = _final_box(state, config)
        if box is None:
            lost.append(LostObject(state.image_box.label, state.image_box, state.steps))
            continue
        # a coarse box around a frustum has no view score and ranks below all boxes confirmed by a view
        score = float(np.sqrt(state.image_box.score * (state.view_score or config.min_view_score)))
        quality = replace(state.quality, image_agreement=image_agreement(frame.camera, state, box, config))
        edges = known_edges(frame.camera, expected_outline(frame.camera, state.image_box, config).box)
        proposals.append(Proposal(state.image_box.label, score, box, state.image_box, state.steps, quality, edges))
    proposals = _agreeing_with_image(proposals)
    rank = np.array([p.score * _agreement(p) for p in proposals])
    keep = nms_3d([p.box for p in proposals], rank, [p.label for p in proposals], NMS_IOU)
    by_score = sorted((proposals[int(i)] for i in keep), key=lambda p: -p.score)
    return FrameProposals(frame.key, tuple(by_score), tuple(lost))


def best_rivals(camera: Camera, states: Sequence[ObjectState], config: RcvConfig) -> list[ObjectState]:
    """For each image box that a class-agnostic detector measured from several crops, the best result.

    A rival's rank is its agreement with the image box, times its score on the views, times the share of the points in
    the middle of the image box that lie inside. The first factor alone would choose badly, because the image box also
    bounds each fit, so that wrong boxes agree with it, too.
    """
    rivals: dict[int, list[ObjectState]] = defaultdict(list)
    for state in states:
        if state.frustum is not None:
            rivals[id(state.image_box)].append(state)
    best = []
    choices = []
    for each in rivals.values():
        first = max(each, key=lambda state: _rival_rank(camera, state, state.frustum, config))
        choice = _choice(first, each)
        if choice is None:
            best.append(first)
        else:
            choices.append(choice)
    return [state for state in states if state.frustum is None] + best + _of_typical_sizes(choices)


_Choice = tuple[ObjectState, Candidates, np.ndarray]
"""The best rival of an image box whose class has a typical size, and the boxes that it may get, with scores (k,)."""


def _choice(best: ObjectState, rivals: Sequence[ObjectState]) -> _Choice | None:
    """The candidates: boxes placed without a detector, the rivals' boxes, and those changed a little.

    So an object that is not detected on any view has a box, too. None if the class has no typical size.
    """
    facts = best.frustum
    if facts is None or facts.evidence is None or facts.placed is None:
        return None
    measured = [(state.box, state.measured) for state in rivals if state.box is not None and state.measured is not None]
    parts = [facts.placed]
    if measured:
        boxes = Candidates.of([box for box, _ in measured])
        parts += [boxes, changed(boxes, facts.evidence, CHANGES, CHANGE_SCALE, np.random.default_rng(0))]
    candidates = Candidates.concatenate(parts)
    return best, candidates, facts.evidence.score(candidates, [intervals for _, intervals in measured])


def _of_typical_sizes(choices: Sequence[_Choice]) -> list[ObjectState]:
    """Each best rival with the best of its candidates; objects with higher scores first, the others do not overlap."""
    taken: list[OrientedBox] = []
    chosen: dict[int, ObjectState] = {}
    for index in sorted(range(len(choices)), key=lambda i: -float(choices[i][2].max())):
        best, candidates, score = choices[index]
        if taken:
            score = score - OVERLAP_WEIGHT * iou_3d_matrix(candidates.boxes, taken).max(axis=1)
        box, iou = best_expected(candidates, score)
        stop = StopReason.STEP_LIMIT if best.stop in (StopReason.LOST, StopReason.TOO_FEW_POINTS) else best.stop
        chosen[index] = replace(best, box=canonical_box(box, best.up), stop=stop, expected_loss=1 - iou)
        taken.append(box)
    return [chosen[index] for index in range(len(choices))]


def _rival_rank(camera: Camera, state: ObjectState, frustum: FrustumFacts | None, config: RcvConfig) -> float:
    box = _final_box(state, config)
    if box is None or frustum is None:
        return -1.0
    margin_m = MIDDLE_MARGIN * float(box.size_m.mean())
    share = float(contains(box, frustum.middle_m, margin_m).mean())
    return image_agreement(camera, state, box, config) * state.view_score * share


def image_agreement(camera: Camera, state: ObjectState, box: OrientedBox, config: RcvConfig) -> float:
    """IoU on the image between the outline of the 3D box and the expected one.

    For silhouettes, between the extent of the object's points and the image box.
    """
    label = state.image_box.label
    if config.box_kind is BoxKind.SILHOUETTE:
        projected = points_on_image(camera, state.cloud.xyz_m, label)
    else:
        projected = box_on_image(camera, box, label)
    expected = expected_outline(camera, state.image_box, config).box
    return 0.0 if projected is None else box_iou(projected, expected)


def _final_box(state: ObjectState, config: RcvConfig) -> OrientedBox | None:
    if state.stop not in (StopReason.LOST, StopReason.TOO_FEW_POINTS):
        return state.box
    return _coarse_box(state, config) if config.coarse_box else None


def _coarse_box(state: ObjectState, config: RcvConfig) -> OrientedBox | None:
    """The last box of a lost object, or the box around its frustum's points (RCV paper, section II.B)."""
    if state.box is not None:
        return state.box
    if len(state.cloud) < MIN_POINTS:
        return None
    return canonical_box(aligned_box(state.cloud.xyz_m, camera_axes(state.up).T), state.up)


def _agreeing_with_image(proposals: Iterable[Proposal]) -> list[Proposal]:
    """The proposal of each frustum that agrees best with the image box, and others above `MIN_IMAGE_AGREEMENT`."""
    by_frustum: dict[int, list[Proposal]] = defaultdict(list)
    for proposal in proposals:
        by_frustum[id(proposal.image_box)].append(proposal)
    agreeing: list[Proposal] = []
    for candidates in by_frustum.values():
        best = max(candidates, key=_agreement)
        agreeing += [p for p in candidates if p is best or _agreement(p) >= MIN_IMAGE_AGREEMENT]
    return agreeing


def _agreement(proposal: Proposal) -> float:
    return proposal.quality.image_agreement or 0.0
