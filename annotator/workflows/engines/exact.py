"""Poses that keep their last bits on the way between processes: scipy's own pickle makes their rotation anew."""

from __future__ import annotations

import copyreg
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import RigidTransform


def transform_of(matrix: Float64[np.ndarray, "*n 4 4"]) -> RigidTransform:
    """The transform that has exactly this matrix."""
    return RigidTransform(matrix, normalize=False)


def _reduced(transform: RigidTransform) -> tuple[Any, ...]:
    return transform_of, (np.asarray(transform.as_matrix(), np.float64),)


def pickle_exactly() -> None:
    """From now on, poses are pickled with all their bits in this process."""
    copyreg.pickle(RigidTransform, _reduced)
