"""The colours of a viewport on a dark page and on a light one, sRGB."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from annotator.types import ReviewState

Color = tuple[int, int, int]


@dataclass(frozen=True)
class Palette:
    """The colours of a theme.

    Attributes:
        states: of boxes.
        selected: the selected box's colour is shifted towards this grey level, by this share.
        grays: of points without colours, from the weakest return of a LiDAR to the strongest.
        grid, rings, camera: what orients the viewer.
        frustum, draft: of an object that is being labelled, and its box.
        ground, labelled, unlabelled: points on the ground, in a box, and in none.
    """

    states: Mapping[ReviewState, Color]
    selected: tuple[int, float]
    grays: tuple[int, int]
    grid: Color
    rings: Color
    camera: Color
    frustum: Color
    draft: Color
    ground: Color
    labelled: Color
    unlabelled: Color


class Theme(StrEnum):
    """The page's theme."""

    DARK = "dark"
    LIGHT = "light"


def _states(proposed: Color, accepted: Color, edited: Color, rejected: Color) -> dict[ReviewState, Color]:
    return dict(
        zip(
            (ReviewState.PROPOSED, ReviewState.ACCEPTED, ReviewState.EDITED, ReviewState.REJECTED),
            (proposed, accepted, edited, rejected),
            strict=True,
        )
    )


PALETTES = {
    # the states have the same colours as on the page (web_assets/js/colors.js)
    Theme.DARK: Palette(
        states=_states((240, 173, 78), (95, 202, 133), (106, 174, 245), (154, 161, 173)),
        selected=(255, 0.45),
        grays=(40, 255),
        grid=(58, 62, 70),
        rings=(96, 102, 114),
        camera=(170, 176, 188),
        frustum=(200, 204, 212),
        draft=(255, 214, 10),
        ground=(44, 47, 53),
        labelled=(92, 98, 108),
        unlabelled=(255, 190, 92),
    ),
    # and on its light parts (web_assets/css/base.css)
    Theme.LIGHT: Palette(
        states=_states((176, 106, 0), (27, 122, 61), (31, 102, 184), (138, 143, 153)),
        selected=(0, 0.1),
        grays=(196, 16),
        grid=(214, 218, 224),
        rings=(168, 174, 184),
        camera=(92, 98, 110),
        frustum=(92, 98, 110),
        draft=(190, 130, 0),
        ground=(222, 225, 230),
        labelled=(164, 170, 180),
        unlabelled=(214, 92, 0),
    ),
}
