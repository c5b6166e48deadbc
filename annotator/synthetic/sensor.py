"""Simulation of a colour camera and a depth camera, from an ideal image.

The depth noise grows with the square of the distance, as for triangulating cameras (see Nguyen, Izadi, Lovell,
"Modeling Kinect Sensor Noise", 3DIMPVT 2012). Depth is missing at grazing angles, along depth
edges and in random pixels, and is rounded to whole millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from annotator.synthetic.render import Rendering


@dataclass(frozen=True)
class Sensor:
    """The imperfections of the two cameras.

    Attributes:
        noise_floor_m, noise_per_m2: standard deviation of depth = floor + per_m2 * z^2.
        nearest_m, farthest_m: range of depth measurements.
        grazing_cos: below this cosine between normal and ray, depth is increasingly often missing.
        edge_step: relative depth step between neighbours that counts as an edge.
        edge_loss: share of edge pixels that lose their depth.
        dropout: share of all pixels that lose their depth, in small clusters.
        blur_px: blur of the colour image.
        colour_noise: standard deviation of the colours, 0..255.
    """

    noise_floor_m: float = 0.0008
    noise_per_m2: float = 0.0009
    nearest_m: float = 0.25
    farthest_m: float = 8.0
    grazing_cos: float = 0.17
    edge_step: float = 0.02
    edge_loss: float = 0.55
    dropout: float = 0.004
    blur_px: float = 0.55
    colour_noise: float = 2.2


def depth_image(ideal: Rendering, sensor: Sensor, random: np.random.Generator) -> UInt16[np.ndarray, "h w"]:
    """The measured depth in millimetres; 0 = no measurement."""
    z = ideal.depth_m
    sigma = np.float32(sensor.noise_floor_m) + np.float32(sensor.noise_per_m2) * z * z
    measured = z + sigma * _correlated_noise(z.shape, random)
    lost = (z < sensor.nearest_m) | (z > sensor.farthest_m)
    lost |= random.random(z.shape, np.float32) > ideal.facing / np.float32(sensor.grazing_cos)
    lost |= _edges(z, sensor.edge_step) & (random.random(z.shape, np.float32) < sensor.edge_loss)
    lost |= _clusters(z.shape, sensor.dropout, random)
    return np.where(lost, 0, np.rint(measured * 1000)).clip(0, 65535).astype(np.uint16)


def colour_image(ideal: Rendering, sensor: Sensor, random: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """The colour camera's image, with blur, vignetting and noise."""
    import cv2

    blurred = cv2.GaussianBlur(ideal.rgb, (0, 0), sensor.blur_px).astype(np.float32)
    height, width = blurred.shape[:2]
    x, y = np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32)
    blurred *= (1 - 0.08 * (x**2 + y[:, None] ** 2))[:, :, None]
    blurred += np.float32(sensor.colour_noise) * random.standard_normal((height, width, 1), np.float32)
    blurred += np.float32(0.5 * sensor.colour_noise) * random.standard_normal(blurred.shape, np.float32)
    return np.clip(blurred + 0.5, 0, 255).astype(np.uint8)


def _correlated_noise(shape: tuple[int, ...], random: np.random.Generator) -> Float32[np.ndarray, "h w"]:
    """Unit noise with half of its variance correlated between neighbours, since depth is measured over windows."""
    import cv2

    independent = random.standard_normal(shape, np.float32)
    # a Gaussian of 1.2 px divides the deviation of white noise by 2 sqrt(pi) 1.2
    shared = cv2.GaussianBlur(random.standard_normal(shape, np.float32), (0, 0), 1.2) * np.float32(2 * np.pi**0.5 * 1.2)
    return np.asarray((independent + shared) * np.float32(0.5**0.5))


def _edges(z: np.ndarray, step: float) -> np.ndarray:
    """Pixels next to a jump in depth."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(z, kernel) - cv2.erode(z, kernel) > step * z)


def _clusters(shape: tuple[int, ...], share: float, random: np.random.Generator) -> np.ndarray:
    """A random share of the pixels, in clusters of 2 x 2."""
    height, width = shape
    clusters = random.random(((height + 1) // 2, (width + 1) // 2), np.float32) < share
    return np.repeat(np.repeat(clusters, 2, axis=0), 2, axis=1)[:height, :width]
