"""The interface of compute devices, which render pseudo-views and compute normals and clusters.

`NumpyCompute` runs on the CPU; `annotator.gpu` implements the same interface on torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Float32, Float64

from annotator.geometry.normals import normals_from_depth
from annotator.rcv.axes import axial_kmeans
from annotator.rcv.config import ViewConfig
from annotator.rcv.pseudo_view import render_pairs
from annotator.types import Camera, Frame, PointCloud, PseudoView


@runtime_checkable
class Compute(Protocol):
    """A compute device for point clouds; thread-safe."""

    def hold(self, frame: Frame) -> Frame:
        """The frame with its cloud on the device; clouds selected from this cloud stay on the device."""

    def render_pairs(
        self,
        cloud: PointCloud,
        axes: Sequence[Float64[np.ndarray, "3 3"]],
        config: ViewConfig,
        show: Float[np.ndarray, "m 3"] | None = None,
    ) -> list[PseudoView]:
        """As `pseudo_view.render_pairs`."""

    def normals_from_depth(self, camera: Camera, depth_m: Float[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
        """As `geometry.normals.normals_from_depth`."""

    def axial_kmeans(
        self, directions: Float64[np.ndarray, "n 3"], clusters: int, seed: int
    ) -> tuple[Float64[np.ndarray, "k 3"], np.ndarray]:
        """As `axes.axial_kmeans`."""


class NumpyCompute:
    """The CPU."""

    def hold(self, frame: Frame) -> Frame:
        """Returns the frame unchanged."""
        return frame

    def render_pairs(
        self,
        cloud: PointCloud,
        axes: Sequence[Float64[np.ndarray, "3 3"]],
        config: ViewConfig,
        show: Float[np.ndarray, "m 3"] | None = None,
    ) -> list[PseudoView]:
        """`pseudo_view.render_pairs`."""
        return render_pairs(cloud, axes, config, show)

    def normals_from_depth(self, camera: Camera, depth_m: Float[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
        """`geometry.normals.normals_from_depth`."""
        return normals_from_depth(camera, depth_m)

    def axial_kmeans(
        self, directions: Float64[np.ndarray, "n 3"], clusters: int, seed: int
    ) -> tuple[Float64[np.ndarray, "k 3"], np.ndarray]:
        """`axes.axial_kmeans`."""
        return axial_kmeans(directions, clusters, seed)


NUMPY = NumpyCompute()
