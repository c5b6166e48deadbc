"""Normals of a depth image on a device: the plane fit of `annotator.geometry.normals`, for all rows at once."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from annotator.geometry.normals import MAX_SLOPE, NOISE, OFFSETS_PX, REACH_PX, SPREAD, px_per_ray
from annotator.geometry.projection import CameraKey, camera_key, pixel_rays, require_image_size
from annotator.types import Camera


def normals_from_depth(camera: Camera, depth_m: Float[np.ndarray, "h w"], device: Any) -> Float32[np.ndarray, "h w 3"]:
    """As `annotator.geometry.normals.normals_from_depth`.

    Args:
        device: a torch device.

    Raises:
        GeometryError: the sizes of depth image and camera differ.
    """
    import torch

    require_image_size(camera, depth_m)
    depth = torch.tensor(depth_m.astype(np.float32), device=device)
    usable = torch.isfinite(depth) & (depth > 0)
    inverse = torch.where(usable, 1.0 / depth, 0.0)
    slope_u, slope_v = _slopes(inverse, MAX_SLOPE / min(camera.fx, camera.fy))
    rays, per_px = _optics(camera_key(camera), str(device))
    along_x = per_px[..., 0, 0] * slope_u + per_px[..., 1, 0] * slope_v
    along_y = per_px[..., 0, 1] * slope_u + per_px[..., 1, 1] * slope_v
    rest = inverse - rays[..., 0] * along_x - rays[..., 1] * along_y
    scale = -1.0 / torch.sqrt(along_x * along_x + along_y * along_y + rest * rest)
    normals: np.ndarray = (
        torch.stack([along_x * scale, along_y * scale, rest * scale], dim=-1).nan_to_num(0.0).cpu().numpy()
    )
    return normals


@lru_cache(maxsize=4)
def _optics(key: CameraKey, device: str) -> tuple[Any, Any]:
    """A camera's rays and their derivatives on the device, cached for all its frames."""
    import torch

    camera = Camera(*key)
    return torch.tensor(pixel_rays(camera), device=device), torch.tensor(px_per_ray(camera), device=device)


def _slopes(inverse: Any, step_per_px: float) -> tuple[Any, Any]:
    """Least-squares slopes along u and v, per pixel, of an inverse depth image; NaN if unknown.

    Args:
        step_per_px: allowed relative difference in depth to a neighbour, per pixel of distance.
    """
    import torch

    rows, columns = inverse.shape
    padded = torch.nn.functional.pad(inverse, (REACH_PX,) * 4)
    uu, uv, vv, ud, vd = (torch.zeros_like(inverse) for _ in range(5))
    for dv in OFFSETS_PX:
        for du in OFFSETS_PX:
            if du == dv == 0:
                continue
            shifted = padded[REACH_PX + dv : REACH_PX + dv + rows, REACH_PX + du : REACH_PX + du + columns]
            difference = shifted - inverse
            # below 1, so that missing neighbours, with an inverse depth of 0, are always excluded
            share = min(step_per_px * (du * du + dv * dv) ** 0.5 + NOISE, 0.5)
            same = (difference.abs() <= share * inverse).to(torch.float32)
            difference = difference * same
            uu += du * du * same
            vv += dv * dv * same
            uv += du * dv * same
            ud += du * difference
            vd += dv * difference
    determinant = uu * vv - uv * uv
    trusted = determinant > SPREAD * 0.25 * (uu + vv) ** 2
    safe = torch.where(trusted & (inverse > 0), determinant, torch.nan)
    return (vv * ud - uv * vd) / safe, (uu * vd - uv * ud) / safe
