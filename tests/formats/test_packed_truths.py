"""Packed boxes are given back bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.formats.packed_truths import PackedTruths
from annotator.types import Box2D, BoxKind, OrientedBox, Truth
from annotator.types.label import AttributeValue, Said


def test_boxes_come_back_bit_for_bit_with_all_that_is_known_of_them() -> None:
    numbers = np.random.default_rng(0)
    boxes = [
        OrientedBox.from_parts(numbers.normal(size=3), np.linalg.qr(turn)[0] * np.sign(np.linalg.det(turn)), size)
        for turn, size in zip(numbers.normal(size=(4, 3, 3)), numbers.uniform(1, 2, (4, 3)), strict=True)
        if np.linalg.det(np.linalg.qr(turn)[0] * np.sign(np.linalg.det(turn))) > 0
    ]
    assert boxes
    frames = {
        "a": [Truth("car", box, 3, 0.25, Box2D("car", 1.0, 2.0, 3.0, 4.0)) for box in boxes],
        "b": [],
        "c": [Truth("car", boxes[0]), Truth("dog", boxes[0], 1, -3.0, None, BoxKind.SILHOUETTE, {"wet": True})],
    }
    packed = PackedTruths(iter(frames.items()))
    assert list(packed) == list(frames) and len(packed) == 3
    assert list(packed.scores) == [0.25] * len(boxes) + [-3.0]
    for name, truths in frames.items():
        for found, given in zip(packed[name], truths, strict=True):
            np.testing.assert_array_equal(found.box.pose, given.box.pose)
            np.testing.assert_array_equal(found.box.size_m, given.box.size_m)
            for field in ("label", "track_id", "score", "image_box", "box_kind", "attributes"):
                assert getattr(found, field) == getattr(given, field)


@pytest.mark.parametrize(("first", "second"), [(True, 1), (1, 1.0), (0, False), (0.0, -0.0)])
def test_equal_values_of_different_kinds_stay_apart(first: AttributeValue, second: AttributeValue) -> None:
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    given = [Truth("car", box, attributes={"wet": value}) for value in (first, second)]
    found = PackedTruths([("a", given)])["a"]
    assert [repr(each.attributes["wet"]) for each in found] == [repr(first), repr(second)]


def test_what_sources_said_is_kept() -> None:
    box = OrientedBox.from_parts(np.zeros(3), np.eye(3), np.ones(3))
    said = (Said("theirs", "dog", box, 0.5),)
    packed = PackedTruths([("a", [Truth("car", box)]), ("b", [Truth("car", box), Truth("car", box, said=said)])])
    assert [[each.said for each in packed[name]] for name in packed] == [[()], [(), said]]
