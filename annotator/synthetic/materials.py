"""Colours and patterns of surfaces: a palette, and the albedo of many points at once."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache

import numpy as np
from jaxtyping import Float32, Integer

Colour = tuple[float, float, float]
GAMMA = 2.2
NOISE_SIZE = 64


class Pattern(IntEnum):
    """The pattern of a material's two colours."""

    PLAIN = 0
    STRIPES = 1
    CHECKS = 2
    PLAID = 3
    PLANKS = 4
    SPOTS = 5


@dataclass(frozen=True)
class Material:
    """One kind of surface.

    Attributes:
        colour, second: the two colours of the pattern, sRGB, 0..1.
        pattern: arrangement of the colours.
        period_m: period of the pattern.
        axis: the texture direction along which the pattern repeats (2 = along a blob's axis).
        grain: relative strength of the random grain.
        grain_m: period of the grain.
        gloss: strength of the highlight.
        glow: emitted light (lamps, windows).
    """

    colour: Colour
    second: Colour = (0.0, 0.0, 0.0)
    pattern: Pattern = Pattern.PLAIN
    period_m: float = 0.1
    axis: int = 2
    grain: float = 0.12
    grain_m: float = 0.25
    gloss: float = 0.0
    glow: float = 0.0


def random_colour(random: np.random.Generator, saturation: float = 0.6, value: float = 0.7) -> Colour:
    """An sRGB colour of any hue, around the given saturation and value."""
    s, v = saturation * random.uniform(0.7, 1.3), value * random.uniform(0.7, 1.2)
    return colorsys.hsv_to_rgb(random.random(), min(s, 1.0), min(v, 1.0))


def wood_colour(random: np.random.Generator) -> Colour:
    """A random brown, sRGB."""
    return colorsys.hsv_to_rgb(random.uniform(0.06, 0.1), random.uniform(0.35, 0.6), random.uniform(0.5, 0.75))


def darker(colour: Colour, by: float = 0.6) -> Colour:
    """The colour times `by`."""
    return (colour[0] * by, colour[1] * by, colour[2] * by)


@dataclass
class Palette:
    """All materials of a scene; meshes refer to them by row."""

    materials: list[Material] = field(default_factory=list)

    def add(self, material: Material) -> int:
        """Adds a material and returns its row."""
        self.materials.append(material)
        return len(self.materials) - 1

    def column(self, name: str) -> Float32[np.ndarray, "m"]:
        """A numeric attribute of all materials."""
        return np.array([getattr(material, name) for material in self.materials], np.float32)

    def albedo(self, rows: Integer[np.ndarray, "n"], texture: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """The linear colours of points, from their material and their coordinates in its solid texture."""
        first = self._linear("colour")[rows]
        second = self._linear("second")[rows]
        pattern = np.array([material.pattern for material in self.materials])[rows]
        share = np.zeros(len(rows), np.float32)
        for kind, function in _SHARES.items():
            chosen = np.flatnonzero(pattern == kind)
            if len(chosen):
                places = self._turned(rows[chosen], texture[chosen])
                share[chosen] = function(places / self.column("period_m")[rows[chosen]][:, None])
        colour = first + (second - first) * share[:, None]
        grain = _noise(texture / self.column("grain_m")[rows][:, None])
        return colour * (1 + self.column("grain")[rows] * grain)[:, None]

    def _linear(self, name: str) -> np.ndarray:
        return np.array([getattr(material, name) for material in self.materials], np.float32) ** np.float32(GAMMA)

    def _turned(self, rows: np.ndarray, texture: np.ndarray) -> np.ndarray:
        """Texture coordinates with the pattern's axis first."""
        order = np.array([[(material.axis + k) % 3 for k in range(3)] for material in self.materials])
        return np.take_along_axis(texture, order[rows], axis=1)


def _stripes(places: np.ndarray) -> np.ndarray:
    return (places[:, 0] % 1 < 0.4).astype(np.float32)


def _checks(places: np.ndarray) -> np.ndarray:
    return (np.floor(places[:, :2]).sum(axis=1) % 2).astype(np.float32)


def _plaid(places: np.ndarray) -> np.ndarray:
    bands = (places[:, :2] % 1 < 0.35).astype(np.float32)
    return bands.mean(axis=1, dtype=np.float32)


def _planks(places: np.ndarray) -> np.ndarray:
    """Boards along the second axis, each with a tone of its own, dark seams and elongated grain."""
    board = np.floor(places[:, 0])
    tone = np.sin(board * 12.9898) * 43758.5453 % 1
    along = places[:, 1] / 9 + tone
    seam = (places[:, 0] % 1 < 0.03) | (along % 1 < 0.004)
    elongated = np.stack([places[:, 0] * 0.9, places[:, 1] * 0.06, tone], axis=1)
    return np.clip(0.6 * tone + 0.16 * _noise(elongated) + 0.9 * seam, 0, 1).astype(np.float32)


def _spots(places: np.ndarray) -> np.ndarray:
    return (_noise(places) > 0.8).astype(np.float32)


_SHARES = {
    Pattern.STRIPES: _stripes,
    Pattern.CHECKS: _checks,
    Pattern.PLAID: _plaid,
    Pattern.PLANKS: _planks,
    Pattern.SPOTS: _spots,
}


def _noise(places: np.ndarray) -> Float32[np.ndarray, "n"]:
    """Smooth noise with mean 0, standard deviation 1, and period 1 along every axis."""
    i = (places * NOISE_SIZE).astype(np.int32) & (NOISE_SIZE - 1)
    return _noise_volume()[i[:, 0], i[:, 1], i[:, 2]]


@cache
def _noise_volume() -> Float32[np.ndarray, "s s s"]:
    """Periodic noise whose amplitude falls with frequency, so that it has structure at all scales."""
    white = np.random.default_rng(0).standard_normal((NOISE_SIZE,) * 3)
    f = np.fft.fftfreq(NOISE_SIZE)
    radius = np.sqrt(f[:, None, None] ** 2 + f[None, :, None] ** 2 + f[None, None, :] ** 2)
    radius[0, 0, 0] = np.inf
    volume = np.fft.ifftn(np.fft.fftn(white) / radius**1.6).real
    return (volume / volume.std()).astype(np.float32)
