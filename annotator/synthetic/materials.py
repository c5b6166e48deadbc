"""Appearance of surfaces and people: colours, patterns and clothes; shading by a lamp with soft shadows."""

from __future__ import annotations

import colorsys
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache

import numpy as np
from jaxtyping import Float32, Int16, Integer, UInt8

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
        axis: the texture direction along which the pattern repeats (2 = along a blob's axis).
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


# From light to dark; a person's tone is interpolated between two neighbours.
SKIN_TONES: tuple[Colour, ...] = ((0.88, 0.71, 0.61), (0.85, 0.66, 0.53), (0.67, 0.48, 0.36), (0.42, 0.29, 0.22))
HAIR_STYLES = ("short", "long", "bald", "cap", "bun")


@dataclass(frozen=True)
class Looks:
    """The build and clothes of one person; materials are rows of the palette.

    Attributes:
        height_m: without shoes.
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


SKY = np.array([0.92, 0.96, 1.0], np.float32)
GROUND = np.array([0.6, 0.53, 0.47], np.float32)
# The lamp is sampled at TILE_PX x TILE_PX points, one per pixel of a tile.
TILE_PX = 4
# Maximum relative depth step within a surface; shadows are not smoothed across larger steps.
SAME_SURFACE = 0.05
SHINE_POWER = 24
CURVE_STEPS = 4096


@dataclass(frozen=True)
class Lights:
    """The light in a room.

    Attributes:
        lamp_m: centre of the lamp, world frame.
        lamp_radius_m: radius of the lamp, which softens shadows.
        key, ambient, fill: strengths of the lamp, of the ambient light, and of the light from the camera.
    """

    lamp_m: tuple[float, float, float]
    lamp_radius_m: float = 0.25
    key: float = 1.1
    ambient: float = 0.8
    fill: float = 0.12


@dataclass(frozen=True, eq=False)
class Surface:
    """n points on surfaces, world frame.

    Attributes:
        position: metres.
        normal: unit, towards the camera.
        texture: coordinates in the part's solid texture, metres.
        material: row of the palette.
        view: unit, to the camera.
    """

    position: Float32[np.ndarray, "n 3"]
    normal: Float32[np.ndarray, "n 3"]
    texture: Float32[np.ndarray, "n 3"]
    material: Int16[np.ndarray, "n"]
    view: Float32[np.ndarray, "n 3"]


def shaded(
    palette: Palette, surface: Surface, lights: Lights
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
    """Linear colours without the lamp, and the lamp's contribution if it is visible."""
    albedo = palette.albedo(surface.material, surface.texture)
    upward = 0.5 + 0.5 * surface.normal[:, 2:]
    around = (SKY * upward + GROUND * (1 - upward)) * np.float32(lights.ambient)
    fill = np.float32(lights.fill) * np.maximum((surface.normal * surface.view).sum(axis=1), 0)
    glow = palette.column("glow")[surface.material]
    base = albedo * (around + (fill + glow)[:, None])

    to_lamp = np.array(lights.lamp_m, np.float32) - surface.position
    square = (to_lamp**2).sum(axis=1)
    to_lamp /= np.sqrt(square)[:, None]
    reach = np.float32(6 * lights.key) / (4 + square)
    diffuse = reach * np.maximum((surface.normal * to_lamp).sum(axis=1), 0)
    half = to_lamp + surface.view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    facing = np.maximum((surface.normal * half).sum(axis=1), 0)
    shine = palette.column("gloss")[surface.material] * reach * facing**SHINE_POWER
    return base, albedo * diffuse[:, None] + shine[:, None]


def lamp_points(lights: Lights, pixels: Integer[np.ndarray, "n"], width_px: int) -> Float32[np.ndarray, "n 3"]:
    """The sample point on the lamp for each pixel (v * width + u); neighbouring pixels use different points."""
    v, u = np.divmod(pixels, width_px)
    k = np.arange(TILE_PX**2)
    turn = k * np.pi * (3 - 5**0.5)  # the golden angle spreads the points evenly over a disc
    radius = lights.lamp_radius_m * np.sqrt((k + 0.5) / TILE_PX**2)
    disc = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.zeros(len(k))], axis=1)
    points = (np.array(lights.lamp_m) + disc).astype(np.float32)
    return points[(u % TILE_PX) + TILE_PX * (v % TILE_PX)]


def softened(lit: Float32[np.ndarray, "h w"], depth_m: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """The visible share of the lamp: the mean over each tile of pixels, but not across depth edges."""
    import cv2

    kernel = np.ones((TILE_PX + 1, TILE_PX + 1), np.uint8)
    flat = cv2.dilate(depth_m, kernel) - cv2.erode(depth_m, kernel) < SAME_SURFACE * np.maximum(depth_m, 0.2)
    weight = flat.astype(np.float32)
    total = cv2.boxFilter(lit * weight, -1, (TILE_PX, TILE_PX), normalize=False)
    count = cv2.boxFilter(weight, -1, (TILE_PX, TILE_PX), normalize=False)
    return np.where(flat, total / np.maximum(count, 1), lit)


def tone_mapped(linear: Float32[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """sRGB-like bytes of linear light; highlights are compressed smoothly."""
    steps = np.arange(CURVE_STEPS, dtype=np.float32) / (CURVE_STEPS - 1) * 2
    curve = np.where(steps < 0.7, steps, 0.7 + 0.3 * np.tanh((steps - 0.7) / 0.3))
    table = (255 * curve ** (1 / GAMMA) + 0.5).astype(np.uint8)
    index = (linear * ((CURVE_STEPS - 1) / 2)).astype(np.int32)
    return table[np.clip(index, 0, CURVE_STEPS - 1)]
