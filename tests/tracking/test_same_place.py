"""Which boxes of one moment stand at the same place."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from annotator.tracking.link import overlap_at_place
from annotator.types import OrientedBox

CAR = (4.0, 1.0, 1.5)


def box(x: float = 0.0, size_m: tuple[float, float, float] = CAR, turn_deg: float = 0.0) -> OrientedBox:
    rotation = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    return OrientedBox.from_parts(np.array([x, 0.0, 0.0]), rotation, np.array(size_m))


@pytest.mark.parametrize(
    ("other", "overlap"),
    [
        (box(), 1.0),
        (box(2.0), 1 / 3),
        (box(2.2), 0.0),
        (box(turn_deg=90.0), 1 / 7),
        (box(0.2, (0.5, 0.5, 0.5)), 0.125 / 6),
        # its centre is in the car, but not the other way round: another object that touches it
        (box(1.0, (0.5, 0.5, 0.5)), 0.0),
        (box(9.0), 0.0),
    ],
    ids=["same", "a third", "less", "turned", "a part", "beside its centre", "elsewhere"],
)
def test_boxes_at_the_same_place(other: OrientedBox, overlap: float) -> None:
    assert overlap_at_place([box(), box(20.0)], [other]) == pytest.approx(np.array([[overlap], [0.0]]))
    assert overlap_at_place([other], [box()]) == pytest.approx(np.array([[overlap]]))


def test_without_boxes_there_is_no_overlap() -> None:
    assert overlap_at_place([box()], []).shape == (1, 0)
    assert overlap_at_place([], [box()]).shape == (0, 1)
