"""The appearance of a person: proportions, clothes, hair, skin."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np

from annotator.synthetic.materials import Colour, Material, Palette, Pattern, random_colour

# From light to dark; a person's tone is interpolated between two neighbours.
SKIN_TONES: tuple[Colour, ...] = ((0.88, 0.71, 0.61), (0.85, 0.66, 0.53), (0.67, 0.48, 0.36), (0.42, 0.29, 0.22))
HAIR_STYLES = ("short", "long", "bald", "cap", "bun")


@dataclass(frozen=True)
class Looks:
    """The build and clothes of one person; materials are rows of the palette.

    Attributes:
        height_m: without shoes.
        girth: 1 = average.
        hair_style: one of `HAIR_STYLES`.
        long_sleeves, long_trousers, skirt, backpack: clothes.
    """

    height_m: float
    girth: float
    hair_style: str
    long_sleeves: bool
    long_trousers: bool
    skirt: bool
    backpack: bool
    skin: int
    shirt: int
    trousers: int
    shoes: int
    hair: int
    dark: int
    bag: int


def random_looks(palette: Palette, random: np.random.Generator, hair_style: str) -> Looks:
    """A random person; their materials are added to the palette."""
    tone = random.uniform(0, len(SKIN_TONES) - 1.001)
    low = int(tone)
    skin = [a + (b - a) * (tone - low) for a, b in zip(SKIN_TONES[low], SKIN_TONES[low + 1], strict=True)]
    shirt = Material(
        random_colour(random, 0.65, 0.65),
        random_colour(random, 0.5, 0.75),
        Pattern(int(random.choice([Pattern.PLAIN, Pattern.PLAIN, Pattern.STRIPES, Pattern.PLAID, Pattern.SPOTS]))),
        random.uniform(0.05, 0.1),
        2,
        grain=0.16,
    )
    trousers = colorsys.hsv_to_rgb(random.uniform(0.5, 1.1) % 1, random.uniform(0.15, 0.6), random.uniform(0.2, 0.55))
    hair = colorsys.hsv_to_rgb(random.uniform(0.04, 0.11), random.uniform(0.3, 0.7), random.uniform(0.08, 0.55))
    skirt = hair_style in ("long", "bun") and random.random() < 0.5
    return Looks(
        height_m=random.uniform(1.56, 1.88),
        girth=random.uniform(0.88, 1.18),
        hair_style=hair_style,
        long_sleeves=bool(random.random() < 0.5),
        long_trousers=bool(random.random() < 0.8),
        skirt=skirt,
        backpack=bool(random.random() < 0.3),
        skin=palette.add(Material((skin[0], skin[1], skin[2]), grain=0.04, grain_m=0.12, gloss=0.06)),
        shirt=palette.add(shirt),
        trousers=palette.add(Material(trousers, grain=0.15)),
        shoes=palette.add(Material(random_colour(random, 0.4, 0.35), gloss=0.2)),
        hair=palette.add(Material(hair, grain=0.3, grain_m=0.1, gloss=0.1)),
        dark=palette.add(Material((0.1, 0.08, 0.08), gloss=0.4)),
        bag=palette.add(Material(random_colour(random, 0.7, 0.5), grain=0.15)),
    )
