"""Appearance of surfaces: colours, patterns and grain, and their shading by a lamp."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from jaxtyping import Bool, Float32, Int16, Integer, UInt8

Colour = tuple[float, float, float]
GAMMA = 2.2
PLAIN = (np.inf, np.inf, np.inf)
# Side of the periodic volume that grain is taken from.
GRAINS = 64


@dataclass(frozen=True)
class Material:
    """One kind of surface.

    Attributes:
        colour, second: the two colours of the pattern, sRGB, 0..1.
        period_m: of the pattern along each axis of the texture, metres: infinite = plain, one finite = stripes, two =
            checks.
        grain, grain_m: strength and size of irregularities.
    """

    colour: Colour
    second: Colour = (0.0, 0.0, 0.0)
    period_m: tuple[float, float, float] = PLAIN
    grain: float = 0.12
    grain_m: float = 0.25


def random_colour(random: np.random.Generator, saturation: float = 0.6, value: float = 0.7) -> Colour:
    """An sRGB colour of any hue, around the given saturation and value."""
    s, v = saturation * random.uniform(0.7, 1.3), value * random.uniform(0.7, 1.2)
    return colorsys.hsv_to_rgb(random.random(), min(s, 1.0), min(v, 1.0))


def wood(random: np.random.Generator) -> Material:
    """A random brown with planks."""
    hue, saturation, value = random.uniform(0.06, 0.1), random.uniform(0.35, 0.6), random.uniform(0.5, 0.75)
    light, dark = (colorsys.hsv_to_rgb(hue, saturation, value * share) for share in (1.0, 0.85))
    return Material(light, dark, (np.inf, 0.3, np.inf))


@dataclass
class Palette:
    """All materials of a scene; meshes refer to them by row."""

    materials: list[Material] = field(default_factory=list)

    def add(self, material: Material) -> int:
        """Adds a material and returns its row."""
        self.materials.append(material)
        return len(self.materials) - 1

    def albedo(self, rows: Integer[np.ndarray, "n"], texture: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """The linear colours of points, from their material and their coordinates in its solid texture."""
        first, second, period, grain = (
            np.array(values, np.float32)[rows]
            for values in zip(
                *((m.colour, m.second, m.period_m, (m.grain, m.grain_m)) for m in self.materials), strict=True
            )
        )
        is_second = np.cos(2 * np.pi * texture / period).prod(axis=1) < 0
        colour = np.where(is_second[:, None], second, first) ** np.float32(GAMMA)
        at = tuple(((texture / grain[:, 1:] * GRAINS).astype(np.int64) % GRAINS).T)
        return np.asarray(colour * np.maximum(1 + grain[:, 0] * _noise()[at], 0)[:, None], np.float32)


@cache
def _noise() -> Float32[np.ndarray, "s s s"]:
    """Periodic noise with mean 0 and standard deviation 1, with structure at all scales."""
    frequency = np.fft.fftfreq(GRAINS)
    radius = np.linalg.norm(np.meshgrid(frequency, frequency, frequency), axis=0)
    radius[0, 0, 0] = np.inf
    volume = np.fft.ifftn(np.fft.fftn(np.random.default_rng(0).standard_normal((GRAINS,) * 3)) / radius**1.6).real
    return (volume / volume.std()).astype(np.float32)


@dataclass(frozen=True)
class Lights:
    """The light in a scene.

    Attributes:
        lamp_m: position of the lamp, world frame.
        key, ambient: strengths of the lamp and of the light from all around.
    """

    lamp_m: tuple[float, float, float]
    key: float = 1.1
    ambient: float = 0.8


@dataclass(frozen=True, eq=False)
class Surface:
    """n points on surfaces, world frame.

    Attributes:
        position: metres.
        normal: unit, towards the camera.
        facing: cosine between normal and view ray; 0 = grazing.
        texture: coordinates in the part's solid texture, metres.
        material: row of the palette.
        track: track id of the labelled object, 0 for everything else.
    """

    position: Float32[np.ndarray, "n 3"]
    normal: Float32[np.ndarray, "n 3"]
    facing: Float32[np.ndarray, "n"]
    texture: Float32[np.ndarray, "n 3"]
    material: Int16[np.ndarray, "n"]
    track: Int16[np.ndarray, "n"]


def shaded(
    albedo: Float32[np.ndarray, "n 3"], surface: Surface, lights: Lights, lit: Bool[np.ndarray, "n"]
) -> UInt8[np.ndarray, "n 3"]:
    """The sRGB colours of points; `lit` tells which ones the lamp reaches."""
    to_lamp = np.array(lights.lamp_m, np.float32) - surface.position
    square = (to_lamp**2).sum(axis=1)
    facing_lamp = np.maximum((surface.normal * to_lamp).sum(axis=1) / np.sqrt(square), 0)
    around = lights.ambient * (0.8 + 0.2 * surface.normal[:, 2]) + 0.12 * surface.facing
    light = around + lit * facing_lamp * (6 * lights.key) / (4 + square)
    return (255 * np.clip(albedo * light[:, None], 0, 1) ** (1 / GAMMA) + 0.5).astype(np.uint8)
