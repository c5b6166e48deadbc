"""Ray casting against triangles; the only module that uses open3d."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32

# Shadow rays start slightly off their surface and end slightly before the lamp.
SHADOW_NEAR = 2e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """The first hits of n rays.

    Attributes:
        t: (n,) multiples of the ray's direction; infinite without a hit.
        triangle: (n,) triangle index, -1 without a hit.
        uv: (n, 2) barycentric weights of the triangle's second and third corner.
    """

    t: Float32[np.ndarray, "n"]
    triangle: Int32[np.ndarray, "n"]
    uv: Float32[np.ndarray, "n 2"]


class RayScene:
    """A triangle mesh for ray casting."""

    def __init__(self, vertices: Float32[np.ndarray, "v 3"], triangles: Int32[np.ndarray, "t 3"]) -> None:
        """Builds the search tree over triangles, given as vertex indices."""
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles.astype(np.uint32)))

    def first_hits(self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]) -> Hits:
        """The nearest triangle on each ray; triangles are hit from both sides."""
        hits = self._scene.cast_rays(self._rays(origins, directions))
        t = hits["t_hit"].numpy()
        triangle = hits["primitive_ids"].numpy().astype(np.int32)
        return Hits(t, np.where(np.isfinite(t), triangle, np.int32(-1)), hits["primitive_uvs"].numpy())

    def blocked(
        self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, "n"]:
        """Which rays hit something between origin and origin + direction."""
        rays = self._rays(origins, directions)
        blocked: np.ndarray = self._scene.test_occlusions(rays, tnear=SHADOW_NEAR, tfar=1.0 - SHADOW_NEAR).numpy()
        return blocked

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate([origins, directions], axis=1))
