"""Whether the sizes of boxes are in metres, and in the order length, width, height.

The usual sizes of well-known classes show their order.
"""

from __future__ import annotations

from collections import Counter
from itertools import permutations

import numpy as np
from jaxtyping import Float64

from annotator.formats.units import Lengths
from annotator.rcv.config import TypicalSize, typical_size
from annotator.types.messages import amount

# Factor by which a side may differ from the usual one, and standard deviations of its class if these are larger.
SIZE_FACTOR, SIZE_DEVIATIONS = 1.6, 3.0
# A class with a side this much longer than another one shows the order of sizes by itself; others need several boxes.
CLEAR_FACTOR, LEAST_UNCLEAR = 2.0, 3
SIDES = ("length", "width", "height")
# Classes whose length is along their heading; others, such as nuScenes' barriers and furniture, may be wider than long.
LONG = frozenset(
    {"car", "van", "truck", "bus", "trailer", "construction_vehicle", "tram"}
    | {"cyclist", "bicyclist", "motorcyclist", "bicycle", "motorcycle"}
)
# Classes that have no upright position.
FREE = frozenset({"hand"})


class SizeDoubts:
    """What the sizes of the boxes of a dataset show: another unit than metres, or another order.

    Attributes:
        lengths: of all boxes.
        orders: of boxes of well-known classes.
    """

    def __init__(self) -> None:
        self.lengths, self.orders = Lengths(), SizeOrders()

    def add(self, label: str, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds a box."""
        self.lengths.add(size_m)
        self.orders.add(label, size_m)

    def problem(self) -> str | None:
        """Returns what the sizes show; None if they seem right."""
        return self.lengths.problem() or self.orders.problem()


class SizeOrders:
    """Whether the sizes of boxes of well-known classes are in the order length, width, height."""

    def __init__(self) -> None:
        self._known = self._clear = 0
        self._orders: Counter[tuple[int, ...]] = Counter()
        self._example: dict[tuple[int, ...], str] = {}

    def add(self, label: str, size_m: Float64[np.ndarray, "3"]) -> None:
        """Adds the size of a box; one of another class shows nothing."""
        # nuScenes' classes are such as vehicle.car
        usual = next((size for name in (label, *label.split(".")) if (size := typical_size(name)) is not None), None)
        if usual is None or usual.label in FREE:
            return
        self._known += 1
        order = _order(usual, size_m)
        if order is not None:
            sides = " x ".join(f"{side:.2f}" for side in size_m)
            self._orders[order] += 1
            self._clear += max(usual.size_m) > CLEAR_FACTOR * min(usual.size_m)
            self._example.setdefault(order, f"{label} of {sides} m (length, width, height)")

    def problem(self) -> str | None:
        """Returns which order most boxes show; None if it is the right one."""
        odd = self._orders.total()
        if odd * 2 <= self._known or (self._clear == 0 and odd < LEAST_UNCLEAR):
            return None
        order, number = self._orders.most_common(1)[0]
        moved = [name for place, name in enumerate(SIDES) if order[place] != place]
        return (
            f"{number} of {amount(self._known, 'box')} of well-known classes {'has' if number == 1 else 'have'} the "
            f"usual size of the class only if {', '.join(moved[:-1])} and {moved[-1]} are exchanged, such as "
            f"{self._example[order]}; check the order in which the sizes are written"
        )


def _order(usual: TypicalSize, size_m: Float64[np.ndarray, "3"]) -> tuple[int, ...] | None:
    """Returns the order of the sides that is usual for the class; None if the present one is, or none is."""
    within = np.log(np.maximum(SIZE_FACTOR, np.exp(SIZE_DEVIATIONS * np.array(usual.spread))))
    fitting = {
        order: float(off.max())
        for order in permutations(range(3))
        if (off := np.abs(np.log(size_m[list(order)] / np.array(usual.size_m))) / within).max() <= 1
    }
    if not fitting or (0, 1, 2) in fitting or (usual.label not in LONG and (1, 0, 2) in fitting):
        return None
    return min(fitting, key=lambda order: fitting[order])
