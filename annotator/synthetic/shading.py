"""Shading of surfaces: a lamp with soft shadows, ambient light, fill light from the camera, and highlights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int16, Integer, UInt8

from annotator.synthetic.materials import GAMMA, Palette

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
