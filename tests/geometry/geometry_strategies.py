"""Hypothesis strategies for boxes, rotations and cameras."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from annotator.types import Camera, OrientedBox


def vectors(reach: float = 1.0) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(*[st.floats(-reach, reach)] * 3).map(lambda v: np.array(v))


@st.composite
def rotations(draw: st.DrawFn) -> Rotation:
    """Any rotation, often a degenerate one: multiples of 45 degrees about an axis."""
    if draw(st.booleans()):
        axis = np.eye(3)[draw(st.integers(0, 2))]
        return Rotation.from_rotvec(axis * draw(st.integers(0, 7)) * np.pi / 4)
    return Rotation.from_euler("ZYX", draw(vectors(np.pi)))


@st.composite
def boxes(draw: st.DrawFn, reach: float = 1.0) -> OrientedBox:
    size = np.array(draw(st.tuples(*[st.floats(0.2, 2.0)] * 3)))
    return OrientedBox.from_parts(draw(vectors(reach)), draw(rotations()).as_matrix(), size)


@st.composite
def cameras(draw: st.DrawFn, size: tuple[int, int] = (64, 48)) -> Camera:
    """A camera without lens distortion, or with moderate coefficients of any length that OpenCV supports."""
    width, height = size
    focal = draw(st.floats(0.9, 1.5)) * width
    ratio = draw(st.floats(0.95, 1.05))
    length = draw(st.sampled_from([0, 4, 5, 8, 12, 14]))
    scale = [0.1, 0.05, 0.005, 0.005, 0.02, 0.05, 0.02, 0.01, 0.005, 0.005, 0.005, 0.005, 0.02, 0.02]
    distortion = tuple(draw(st.floats(-s, s)) for s in scale[:length])
    center = (width * draw(st.floats(0.4, 0.6)), height * draw(st.floats(0.4, 0.6)))
    return Camera(width, height, focal, focal * ratio, *center, distortion)


def random_boxes(count: int, seed: int, reach: float = 0.5) -> list[OrientedBox]:
    """Boxes that overlap in many ways."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, rng=rng).as_matrix()
    return [OrientedBox.from_parts(rng.normal(size=3) * reach, turn, rng.uniform(0.3, 2.0, 3)) for turn in turns]
