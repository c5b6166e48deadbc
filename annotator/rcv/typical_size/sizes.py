"""Typical sizes of classes: of those in the settings, and of well-known ones by name.

Sources of the means: KITTI (Geiger et al., CVPR 2012) and nuScenes (Caesar et al., CVPR 2020) for traffic; SUN RGB-D's
furniture as averaged for VoteNet (Qi et al., ICCV 2019); for hands, relaxed and as fists, common anthropometry. Spreads
are rough.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Side = Annotated[float, Field(gt=0)]
Spread = Annotated[float, Field(gt=0, le=2)]


class TypicalSize(BaseModel):
    """The typical size of a class.

    Attributes:
        label: class name.
        size_m: sides, metres; the last one is the height of upright boxes, and the order of the others does not matter.
        spread: standard deviation of the logarithm of each side; 0.1 means about 10 %.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    label: str
    size_m: tuple[Side, Side, Side]
    spread: tuple[Spread, Spread, Spread]


# length, width and height in metres; their spreads; names
_KNOWN: tuple[tuple[tuple[float, float, float], tuple[float, float, float], str], ...] = (
    ((3.9, 1.63, 1.55), (0.12, 0.07, 0.08), "car"),
    ((4.8, 1.9, 2.1), (0.15, 0.07, 0.12), "van"),
    ((7.0, 2.5, 2.9), (0.35, 0.1, 0.2), "truck"),
    ((11.0, 2.9, 3.5), (0.2, 0.07, 0.1), "bus"),
    ((12.0, 2.9, 3.9), (0.3, 0.1, 0.15), "trailer"),
    ((6.5, 2.8, 3.2), (0.3, 0.15, 0.15), "construction_vehicle"),
    ((16.0, 2.5, 3.5), (0.15, 0.07, 0.07), "tram"),
    ((0.85, 0.65, 1.75), (0.25, 0.15, 0.07), "pedestrian"),
    ((0.8, 0.6, 1.27), (0.2, 0.15, 0.1), "person_sitting"),
    ((1.77, 0.65, 1.73), (0.1, 0.15, 0.07), "cyclist bicyclist motorcyclist"),
    ((1.7, 0.6, 1.2), (0.1, 0.2, 0.15), "bicycle"),
    ((2.1, 0.8, 1.4), (0.12, 0.2, 0.15), "motorcycle"),
    ((2.4, 0.5, 1.0), (0.3, 0.2, 0.15), "barrier"),
    ((0.41, 0.41, 1.07), (0.25, 0.25, 0.25), "traffic_cone"),
    ((0.16, 0.1, 0.07), (0.25, 0.2, 0.25), "hand"),
    ((2.1, 1.6, 0.95), (0.15, 0.25, 0.3), "bed"),
    ((1.3, 0.8, 0.72), (0.4, 0.35, 0.2), "table"),
    ((1.35, 0.7, 0.75), (0.3, 0.25, 0.2), "desk"),
    ((1.9, 0.92, 0.85), (0.3, 0.15, 0.15), "sofa couch"),
    ((0.6, 0.55, 0.83), (0.2, 0.2, 0.2), "chair"),
    ((0.7, 0.45, 0.75), (0.15, 0.15, 0.15), "toilet"),
    ((1.0, 0.53, 1.15), (0.35, 0.2, 0.35), "dresser"),
    ((0.6, 0.5, 0.65), (0.3, 0.25, 0.25), "night_stand"),
    ((1.07, 0.4, 1.65), (0.4, 0.3, 0.3), "bookshelf"),
    ((1.5, 0.77, 0.5), (0.2, 0.15, 0.2), "bathtub"),
)
WELL_KNOWN: Mapping[str, TypicalSize] = {
    name: TypicalSize(label=name, size_m=size, spread=spread)
    for size, spread, names in _KNOWN
    for name in names.split()
}


def typical_size(label: str, given: Iterable[TypicalSize] = ()) -> TypicalSize | None:
    """The typical size of a class: the first given one, else that of a well-known class of this name, else None.

    Case, and spaces or hyphens in place of underscores, make no difference.
    """
    name = _normalised(label)
    own = next((size for size in given if _normalised(size.label) == name), None)
    return own or WELL_KNOWN.get(name)


def _normalised(label: str) -> str:
    return label.strip().lower().replace(" ", "_").replace("-", "_")
