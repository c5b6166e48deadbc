"""`annotator.rcv.compute.Compute` on a torch device."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, Float64

from annotator.gpu import drawing, kmeans, normals
from annotator.gpu.points import DeviceCloud
from annotator.rcv.config import ViewConfig
from annotator.types import Camera, Frame, PointCloud, PseudoView
from annotator.types.errors import ComputeError


class TorchCompute:
    """Views, normals and clusters on a torch device; thread-safe.

    Attributes:
        device: name of the device, such as "cuda" or "cuda:1".
    """

    def __init__(self, device: str) -> None:
        """
        Args:
            device: a device with double precision (CUDA, CPU).

        Raises:
            ComputeError: the device does not exist or lacks double precision.
        """
        import torch

        self.device = device
        try:
            torch.empty(1, dtype=torch.float64, device=device)
        except (RuntimeError, AssertionError, TypeError) as error:  # AssertionError: no CUDA; MPS has no float64
            raise ComputeError(_problem(device, error)) from error

    def hold(self, frame: Frame) -> Frame:
        """The frame with its points uploaded; clouds selected from its cloud use the same points on the device.

        Raises:
            ComputeError: the device fails, for example because it is out of memory; also in the other methods.
        """
        with self._running():
            return replace(frame, cloud=DeviceCloud.of(frame.cloud, self.device))

    def render_pairs(
        self,
        cloud: PointCloud,
        axes: Sequence[Float64[np.ndarray, "3 3"]],
        config: ViewConfig,
        show: Float[np.ndarray, "m 3"] | None = None,
    ) -> list[PseudoView]:
        """As `annotator.rcv.pseudo_view.render_pairs`; a cloud that is not on the device is uploaded."""
        with self._running():
            return drawing.render_pairs(DeviceCloud.of(cloud, self.device), axes, config, show)

    def normals_from_depth(self, camera: Camera, depth_m: Float[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 3"]:
        """As `annotator.geometry.normals.normals_from_depth`."""
        with self._running():
            return normals.normals_from_depth(camera, depth_m, self.device)

    def axial_kmeans(
        self, directions: Float64[np.ndarray, "n 3"], clusters: int, seed: int
    ) -> tuple[Float64[np.ndarray, "k 3"], np.ndarray]:
        """As `annotator.rcv.axes.axial_kmeans`."""
        with self._running():
            return kmeans.axial_kmeans(directions, clusters, seed, self.device)

    @contextmanager
    def _running(self) -> Iterator[None]:
        import torch

        try:
            with torch.inference_mode():
                yield
        except RuntimeError as error:
            raise ComputeError(_problem(self.device, error)) from error


def _problem(device: str, error: Exception) -> str:
    reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return f"torch cannot process points on {device} ({reason}); run the detectors on the CPU instead"


@lru_cache(maxsize=8)
def torch_compute(device: str) -> TorchCompute:
    """The cached instance for a device.

    Raises:
        ComputeError: the device does not exist or lacks double precision.
    """
    return TorchCompute(device)
