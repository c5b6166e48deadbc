"""What an object starts from that a class-agnostic view detector measures.

A detector that was not trained on the project's objects often fails in the view of a whole frustum. So an object starts
from rivals: boxes of its class's typical size, placed anywhere in the frustum, or else crops along the depth. Both take
several times as long as one start.

A trained detector looks at the whole frustum first, if the class has a typical size. If what it sees agrees with the
image box, boxes are placed around that only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from annotator.geometry.oriented_box import canonical_box, contains
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import image_agreement
from annotator.rcv.first_look import depth_crops, expected_outline, in_middle
from annotator.rcv.pseudo_view import is_deep
from annotator.rcv.recursion import FrustumFacts, ObjectState
from annotator.rcv.typical_size import Evidence, distinct, place, place_near
from annotator.types import Camera, StopReason

# Points of the middle of an image box that are kept to compare rivals.
MIDDLE_POINTS = 500
# Of a class with a typical size: the number of boxes to start from, their maximum IoU, the margin around each within
# which its points lie (share of its mean side), and the note in the trace.
STARTS, STARTS_IOU, START_ROOM = 3, 0.5, 0.1
TYPICAL_SIZE = "started from a box of the class's typical size"
# The same number after a trained detector's look at the frustum; these boxes share the hypotheses of the wide step.
STARTS_AFTER_LOOK = 2
# IoU on the image from which the box that such a look has found is used, and the note in the trace if it is not.
LOOK_AGREEMENT = 0.5
NOT_SEEN = "the view of the whole frustum shows no box that agrees with the image box"


def begin(camera: Camera, state: ObjectState, config: RcvConfig) -> list[ObjectState]:
    """The states of an object before its first step.

    Args:
        state: from `recursion.start`.
    """
    if not config.class_agnostic or state.stop is not StopReason.CONTINUES:
        return [state]
    # the views of a deep frustum show too little of an object
    if config.trained and not is_deep(state.cloud, config):
        evidence = _evidence(camera, state, config)
        if evidence is not None:
            return [replace(state, frustum=replace(_facts(camera, state), evidence=evidence), cold=state)]
    return start_rivals(camera, state, config)


def after_look(camera: Camera, cold: ObjectState, seen: Sequence[ObjectState], config: RcvConfig) -> list[ObjectState]:
    """The states with which an object continues after a trained detector's look at its frustum.

    Args:
        cold: the state before the look.
        seen: the states after it, one for each box.
    """
    agreements = [_agreement(camera, state, config) for state in seen]
    best = seen[int(np.argmax(agreements))]
    facts = best.frustum
    if max(agreements) < LOOK_AGREEMENT or best.box is None or facts is None or facts.evidence is None:
        return start_rivals(camera, replace(cold, notes=(*cold.notes, NOT_SEEN)), config)
    facts = replace(facts, placed=place_near(facts.evidence, best.box))
    started = _placed(replace(best, cold=None), facts, STARTS_AFTER_LOOK, config)
    return [replace(state, rivals=len(started)) for state in started]


def _agreement(camera: Camera, state: ObjectState, config: RcvConfig) -> float:
    """The IoU of the state's box with the image box; 0 without a box, or with too few points to go on."""
    if state.box is None or state.stop is StopReason.TOO_FEW_POINTS:
        return 0.0
    return image_agreement(camera, state, state.box, config)


def start_rivals(camera: Camera, state: ObjectState, config: RcvConfig) -> list[ObjectState]:
    """The rivals of an object: plausible boxes of the typical size of its class, or its frustum and crops of it.

    Args:
        state: from `recursion.start`.
    """
    facts, evidence = _facts(camera, state), _evidence(camera, state, config)
    if evidence is not None:
        return _placed(state, replace(facts, evidence=evidence, placed=place(evidence)), STARTS, config)
    crops = depth_crops(camera, state.cloud.xyz_m, state.image_box, config.first_look, config.min_points)
    whole = [] if crops and is_deep(state.cloud, config) else [replace(state, frustum=facts)]
    return whole + [replace(state, cloud=state.cloud.select(crop), frustum=facts) for crop in crops]


def _facts(camera: Camera, state: ObjectState) -> FrustumFacts:
    xyz_m = state.cloud.xyz_m
    middle = xyz_m[in_middle(camera, xyz_m, state.image_box)]
    return FrustumFacts(state.cloud, middle[:: max(len(middle) // MIDDLE_POINTS, 1)], camera)


def _evidence(camera: Camera, state: ObjectState, config: RcvConfig) -> Evidence | None:
    """What is known of an object of a class with a typical size; None for other classes."""
    typical = config.typical_size(state.image_box.label)
    if typical is None:
        return None
    outline = expected_outline(camera, state.image_box, config)
    return Evidence.of(camera, state.cloud.xyz_m, state.image_box, outline, typical, state.up)


def _placed(state: ObjectState, facts: FrustumFacts, count: int, config: RcvConfig) -> list[ObjectState]:
    """The states that start from the best placed boxes; without their points, the state that has only the frustum."""
    assert facts.placed is not None
    state = replace(state, frustum=facts, notes=(*state.notes, TYPICAL_SIZE))
    started = []
    for placed in distinct(facts.placed, count, STARTS_IOU):
        box = canonical_box(placed, state.up)
        cloud = facts.cloud.select(contains(box, facts.cloud.xyz_m, START_ROOM * float(box.size_m.mean())))
        if len(cloud) >= config.min_points:
            started.append(replace(state, cloud=cloud, box=box, axes=box.rotation.T))
    return started or [state]
