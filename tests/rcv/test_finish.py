"""The selection of a frame's final boxes by their agreement with the image boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import frame_with, some_box

from annotator.geometry.outline import box_on_image
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import finish, image_agreement
from annotator.rcv.recursion import ObjectState
from annotator.types import Box2D, BoxKind, Frame, OrientedBox, StopReason

OWN = some_box([-0.3, 0.1, 2.2], [0, 0.5, 0], [0.6, 0.8, 0.3])
OTHER = some_box([0.9, 0.0, 3.0], [0, 0.2, 0], [0.4, 0.5, 0.3])


def seen(frame: Frame, box: OrientedBox) -> Box2D:
    found = box_on_image(frame.camera, box, "thing")
    assert found is not None
    return found


def ended(frame: Frame, image_box: Box2D, box: OrientedBox, points: slice = slice(0, 800)) -> ObjectState:
    mask = np.zeros(len(frame.cloud), bool)
    mask[points] = True
    stop = StopReason.BOX_CONVERGED
    cloud = frame.cloud.select(mask)
    return ObjectState(0, image_box, cloud, None, np.eye(3), box=box, view_score=0.9, stop=stop)


@pytest.fixture
def frame() -> Frame:
    return frame_with([OWN, OTHER])[0]


def result(frame: Frame, states: Sequence[ObjectState], **settings: object) -> list[OrientedBox]:
    return [p.box for p in finish(frame, states, RcvConfig(**settings)).proposals]


def test_agreement_is_the_iou_on_the_image(frame: Frame) -> None:
    exact = seen(frame, OWN)
    (found,) = finish(frame, [ended(frame, exact, OWN)], RcvConfig()).proposals
    assert found.quality.image_agreement == pytest.approx(1)
    half = replace(exact, x_max=(exact.x_min + exact.x_max) / 2)
    (found,) = finish(frame, [ended(frame, half, OWN)], RcvConfig()).proposals
    assert found.quality.image_agreement == pytest.approx(0.5)
    behind = some_box([0, 0, -5], [0, 0, 0], [1, 1, 1])
    assert image_agreement(frame.camera, ended(frame, exact, OWN), behind, RcvConfig()) == 0


def test_the_agreement_of_silhouettes_uses_their_points(frame: Frame) -> None:
    """The points may cover less than the box."""
    state = ended(frame, seen(frame, OWN), OWN)
    left = frame.cloud.xyz_m[:800, 0] < OWN.center_m[0]
    part = replace(state, cloud=state.cloud.select(left))
    config = RcvConfig(box_kind=BoxKind.SILHOUETTE)
    assert image_agreement(frame.camera, state, OWN, config) > 0.9
    assert 0.3 < image_agreement(frame.camera, part, OWN, config) < 0.7
    assert image_agreement(frame.camera, part, OWN, RcvConfig()) == pytest.approx(1)


def test_a_disagreeing_second_object_is_dropped_but_never_the_best(frame: Frame) -> None:
    image_box = seen(frame, OWN)
    both = [ended(frame, image_box, OTHER), ended(frame, image_box, OWN)]
    assert len(result(frame, both, min_image_agreement=0.0)) == 2
    (kept,) = result(frame, both, min_image_agreement=0.2)
    assert kept is OWN
    assert len(result(frame, both[:1], min_image_agreement=1.0)) == 1, "the only object of its frustum is kept"


@pytest.mark.parametrize("order", [1, -1])
def test_of_duplicates_the_one_from_the_objects_own_frustum_is_kept(frame: Frame, order: int) -> None:
    own, neighbours = seen(frame, OWN), seen(frame, OTHER)
    better = ended(frame, own, OWN)
    worse = ended(frame, replace(neighbours, score=1.0), OrientedBox(OWN.pose, OWN.size_m * 0.9))
    (found,) = finish(frame, [worse, better][::order], RcvConfig(min_image_agreement=0.0)).proposals
    assert found.image_box == own


def test_proposals_are_sorted_by_score(frame: Frame) -> None:
    """Even where the agreement selects between duplicates."""
    doubtful = replace(seen(frame, OWN), score=0.3)
    sure = replace(seen(frame, OTHER), x_max=639.0, y_max=479.0)
    found = finish(frame, [ended(frame, doubtful, OWN), ended(frame, sure, OTHER)], RcvConfig()).proposals
    assert [p.box for p in found] == [OTHER, OWN]
    assert found[0].score > found[1].score
