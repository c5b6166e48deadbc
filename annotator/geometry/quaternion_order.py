"""Whether a set of quaternions is in the order that its format has: w first, or w last.

What stands upright, such as boxes and vehicles, does so in one order only, unless it is turned by half a circle or not
at all. One quaternion seldom shows the order, but all of a set together do.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from annotator.types.amounts import amount
from annotator.types.errors import UnitError, UnitKind

# What is upright in a level frame; least cosine of its tilt: slopes, and drives over bumps.
UPRIGHT = math.cos(math.radians(10))
# Share of the set that is upright if the quaternions are read in the other order.
NEARLY_ALL = 0.95


class Quaternions:
    """The quaternions of a set of things that stand upright in their frame, as they are in the file.

    Args:
        w_first: the format's order is w x y z; False: x y z w.
        thing, things: words for one of them and for several, with the verb.
    """

    def __init__(self, *, w_first: bool = True, thing: str = "box is", things: str = "boxes are") -> None:
        self._w_first, self._thing, self._things = w_first, thing, things
        self._values = array("d")

    def add(self, quaternion: Iterable[float]) -> None:
        """Adds the quaternion of one of them."""
        self._values.extend(quaternion)

    def problem(self) -> str | None:
        """Returns what shows that the quaternions are in the other order; None if nothing does."""
        values = np.array(self._values).reshape(-1, 4)
        if len(values) == 0:
            return None
        first, last = _upright(values, w_first=True), _upright(values, w_first=False)
        own, other = (first, last) if self._w_first else (last, first)
        if other.mean() < NEARLY_ALL or other.sum() <= own.sum():
            return None
        orders = ("w x y z", "x y z w") if self._w_first else ("x y z w", "w x y z")
        tilted = len(own) - int(own.sum())
        return (
            f"the quaternions are in the order {orders[1]}, and this format has {orders[0]}: as {orders[0]}, "
            f"{tilted} of {amount(len(own), self._thing, self._things)} tilted, and as {orders[1]} "
            f"{len(own) - int(other.sum())}; write them as {orders[0]}"
        )

    def require(self, path: Path) -> None:
        """
        Raises:
            UnitError: the quaternions are in the other order.
        """
        if (problem := self.problem()) is not None:
            raise UnitError(UnitKind.QUATERNION, path, problem)


def _upright(values: Float64[np.ndarray, "n 4"], *, w_first: bool) -> np.ndarray:
    """Returns which quaternions leave the z axis upright: R[2, 2] = 1 - 2 (x^2 + y^2) of a unit quaternion."""
    x, y = (values[:, 1], values[:, 2]) if w_first else (values[:, 0], values[:, 1])
    squares = (values**2).sum(axis=1)
    return 1 - 2 * (x**2 + y**2) / np.where(squares > 0, squares, 1) > UPRIGHT
