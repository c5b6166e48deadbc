"""Ray casting against triangles: the one file that knows open3d."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32

# Shadow rays start a little off their surface and end a little before the light.
SHADOW_NEAR = 2e-3


@dataclass(frozen=True, eq=False)
class Hits:
    """What n rays met first.

    Attributes:
        t: (n,) multiples of the ray's direction; infinite where it met nothing.
        triangle: (n,) triangle number, -1 where it met nothing.
        uv: (n, 2) barycentric weights of the triangle's second and third corner.
    """

    t: Float32[np.ndarray, "n"]
    triangle: Int32[np.ndarray, "n"]
    uv: Float32[np.ndarray, "n 2"]


class RayScene:
    """Triangles that rays can be cast against."""

    def __init__(self, vertices: Float32[np.ndarray, "v 3"], triangles: Int32[np.ndarray, "t 3"]) -> None:
        """Builds the search tree over triangles given as vertex numbers."""
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(self._tensor(vertices), self._tensor(triangles.astype(np.uint32)))

    def first_hits(self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]) -> Hits:
        """The nearest triangle on each ray, seen from either side."""
        answer = self._scene.cast_rays(self._rays(origins, directions))
        t = answer["t_hit"].numpy()
        triangle = answer["primitive_ids"].numpy().astype(np.int32)
        return Hits(t, np.where(np.isfinite(t), triangle, np.int32(-1)), answer["primitive_uvs"].numpy())

    def blocked(
        self, origins: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, "n"]:
        """Whether anything lies between origin and origin + direction."""
        rays = self._rays(origins, directions)
        blocked: np.ndarray = self._scene.test_occlusions(rays, tnear=SHADOW_NEAR, tfar=1.0 - SHADOW_NEAR).numpy()
        return blocked

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate([origins, directions], axis=1))
