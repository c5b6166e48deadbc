"""A frame's points on a device: uploaded once, then referred to by their indices."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int32

from annotator.rcv.drawing import BACKGROUND
from annotator.rcv.pseudo_view import point_colors
from annotator.types import PointCloud


@dataclass(frozen=True, eq=False)
class DevicePoints:
    """All points of a frame, on a device.

    Attributes:
        xyz: float32 tensor (3, n), metres, camera frame.
        colors: uint8 tensor (n + 1, 3), the background last; None to shade by depth.
    """

    xyz: Any
    colors: Any

    @classmethod
    def upload(cls, cloud: PointCloud, device: Any) -> DevicePoints:
        """Copies a cloud to a torch device."""
        import torch

        xyz = torch.tensor(np.ascontiguousarray(cloud.xyz_m.T), device=device)
        colors = point_colors(cloud)
        if colors is None:
            return cls(xyz, None)
        background = np.full((1, 3), BACKGROUND, np.uint8)
        return cls(xyz, torch.tensor(np.concatenate([colors, background]), device=device))


@dataclass(frozen=True, eq=False)
class DeviceCloud(PointCloud):
    """A selection of a frame's points. All points of the frame stay on a device, and further selections share them.

    Attributes:
        held: all points of the frame.
        rows: (n,) index of each point of this cloud among them.
    """

    held: DevicePoints = field(kw_only=True)
    rows: Int32[np.ndarray, "n"] = field(kw_only=True)

    @classmethod
    def of(cls, cloud: PointCloud, device: Any) -> DeviceCloud:
        """Uploads a cloud; returns a cloud that is already on a device unchanged."""
        if isinstance(cloud, DeviceCloud):
            return cloud
        return cls._from(cloud, DevicePoints.upload(cloud, device), np.arange(len(cloud), dtype=np.int32))

    def select(self, keep: np.ndarray) -> DeviceCloud:
        """As `PointCloud.select`, without an upload of points."""
        index = np.flatnonzero(keep) if keep.dtype == np.bool_ else keep
        return self._from(super().select(index), self.held, self.rows.take(index))

    @classmethod
    def _from(cls, cloud: PointCloud, held: DevicePoints, rows: np.ndarray) -> DeviceCloud:
        return cls(cloud.xyz_m, cloud.rgb, cloud.reflectance, cloud.pixel_index, cloud.normals, held=held, rows=rows)

    def on_device(self) -> DevicePoints:
        """A copy of only these points on the device; only their indices are uploaded."""
        import torch

        rows = torch.tensor(self.rows, device=self.held.xyz.device)
        xyz = self.held.xyz.index_select(1, rows)
        if self.held.colors is None:
            return DevicePoints(xyz, None)
        last = torch.full_like(rows[:1], len(self.held.colors) - 1)
        return DevicePoints(xyz, self.held.colors.index_select(0, torch.cat([rows, last])))
