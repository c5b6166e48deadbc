"""The boxes of many frames in a tenth of the memory that they take as objects."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float64

from annotator.types import Box2D, BoxKind, OrientedBox, Truth
from annotator.types.label import AttributeValue, Said

# The pose, as the upper three rows of its matrix, and the size.
POSE, SIZE = 12, 3
NUMBERS = POSE + SIZE

_Others = tuple[str, int | None, Box2D | None, BoxKind, tuple[tuple[str, AttributeValue], ...]]
"""All of an object but its numbers; few objects differ in it."""


class PackedTruths(Mapping[str, tuple[Truth, ...]]):
    """The objects of each frame, by its name; a frame's objects are made anew when another frame was asked for before.

    Args:
        frames: the names, all different, and objects, read one by one.
    """

    def __init__(self, frames: Iterable[tuple[str, Sequence[Truth]]]) -> None:
        self._numbers = array("d")
        self._scores = array("d")
        self._others: list[_Others] = []
        self._places: dict[str, range] = {}
        self._said: dict[int, tuple[Said, ...]] = {}
        # a frame is often asked for several times in a row
        self._last: tuple[str | None, tuple[Truth, ...]] = (None, ())
        known: dict[tuple[_Others, str], _Others] = {}
        for name, truths in frames:
            self._places[name] = range(len(self._others), len(self._others) + len(truths))
            for truth in truths:
                self._numbers.extend(truth.box.pose[:3].ravel().tolist())
                self._numbers.extend(truth.box.size_m.tolist())
                self._scores.append(np.nan if truth.score is None else truth.score)
                if truth.said:
                    self._said[len(self._others)] = truth.said
                values = tuple(truth.attributes.items())
                others = (truth.label, truth.track_id, truth.image_box, truth.box_kind, values)
                # True, 1 and 1.0 are equal, but different values
                self._others.append(known.setdefault((others, repr(values)), others))

    @property
    def scores(self) -> Iterator[float]:
        """The scores of all objects that have one."""
        return (score for score in self._scores if score == score)

    @property
    def sizes_m(self) -> Iterator[Float64[np.ndarray, "3"]]:
        """The sizes of all objects."""
        return iter(np.array(self._numbers).reshape(-1, NUMBERS)[:, POSE:])

    def __getitem__(self, name: str) -> tuple[Truth, ...]:
        known, truths = self._last
        if known != name:
            truths = tuple(map(self._truth, self._places[name]))
            self._last = (name, truths)
        return truths

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def _truth(self, place: int) -> Truth:
        numbers = np.array(self._numbers[place * NUMBERS : (place + 1) * NUMBERS])
        pose = np.eye(4)
        pose[:3] = numbers[:POSE].reshape(3, 4)
        box = OrientedBox(pose, numbers[POSE:])
        score = self._scores[place]
        label, track_id, image_box, kind, values = self._others[place]
        said = self._said.get(place, ())
        return Truth(label, box, track_id, None if score != score else score, image_box, kind, dict(values), said)
