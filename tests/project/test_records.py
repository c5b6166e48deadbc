"""Values stored in an event are read back without loss."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import RigidTransform
from store_samples import boxes_2d, oriented_boxes, proposal_at, proposals, same_box

from annotator.project.log.event_types import PAYLOAD, ImageBoxesSet, LabelCreated
from annotator.project.log.records import BoxRecord, ProposalRecord, ViewGeometry, storable
from annotator.types import Box2D, BoxKind, OrientedBox, PseudoView
from annotator.types.errors import ProjectError


@given(oriented_boxes())
def test_a_box_is_read_back_bit_for_bit(box: OrientedBox) -> None:
    assert same_box(BoxRecord.model_validate_json(BoxRecord.of(box).model_dump_json()).box(), box)


@given(proposals())
def test_a_proposal_is_read_back_exactly(proposal) -> None:
    back = ProposalRecord.model_validate_json(ProposalRecord.of(proposal).model_dump_json()).proposal()
    assert same_box(back.box, proposal.box)
    for field in ("label", "score", "image_box", "trace", "quality"):
        assert getattr(back, field) == getattr(proposal, field)


@given(st.lists(boxes_2d(), max_size=4).map(tuple), st.sampled_from(BoxKind))
def test_boxes_are_read_back_exactly(boxes: tuple[Box2D, ...], kind: BoxKind) -> None:
    payload = ImageBoxesSet(boxes=boxes, box_kind=kind)
    assert PAYLOAD.validate_json(payload.model_dump_json()) == payload


def test_the_geometry_of_a_view_is_read_back() -> None:
    axes = np.eye(3)[[1, 2, 0]]
    picture, no_points = np.zeros((4, 5, 3), np.uint8), np.zeros((0, 3), np.float32)
    view = PseudoView(picture, axes, 0.01, np.array([-1.0, 0.5]), no_points, look_px=224)
    geometry = ViewGeometry.model_validate_json(ViewGeometry.of(view).model_dump_json())
    assert np.array_equal(np.array(geometry.axes), axes)
    assert (geometry.metres_per_px, geometry.origin_m, geometry.look_px) == (0.01, (-1.0, 0.5), 224)


NEW = LabelCreated(uid="a", label="hand", box=BoxRecord.of(OrientedBox.at(RigidTransform.identity(), np.ones(3))))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"uid":"a"', '"uid":"a","extra":1'),
        ('"kind":"label_created"', '"kind":"label_painted"'),
        ('"size_m":[1.0,1.0,1.0]', '"size_m":[1.0,1.0,-1.0]'),
        ('"size_m":[1.0,1.0,1.0]', '"size_m":[1.0,1.0,"NaN"]'),
        ("[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]", "[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,-1.0]]"),
        ("[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.0,1.0]]", "[[1.0,0.0,0.0],[0.0,1.0,0.0],[0.0,0.1,1.0]]"),
        ('"state":"accepted"', '"state":"proposed"'),
    ],
)
def test_an_invalid_event_is_refused(old: str, new: str) -> None:
    content = NEW.model_dump_json()
    assert old in content
    assert PAYLOAD.validate_json(content) == NEW
    with pytest.raises(ValidationError):
        PAYLOAD.validate_json(content.replace(old, new))


def test_unknown_fields_deep_in_a_trace_are_refused() -> None:
    content = ProposalRecord.of(proposal_at()).model_dump_json()
    assert '"metres_per_px"' in content
    with pytest.raises(ValidationError, match="Unexpected keyword"):
        ProposalRecord.model_validate_json(content.replace('"metres_per_px"', '"typo":1,"metres_per_px"', 1))


def test_a_pose_with_an_invalid_rotation_is_refused_with_a_clear_error() -> None:
    sheared = np.eye(4)
    sheared[0, 1] = 0.5
    with (
        pytest.raises(ProjectError, match=r"this box cannot be stored: rotation: .*not a rotation"),
        storable("this box"),
    ):
        BoxRecord.of(OrientedBox(sheared, np.ones(3)))
