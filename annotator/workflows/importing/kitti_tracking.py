"""KITTI tracking labels of whole sequences."""

from __future__ import annotations

from pathlib import Path

from annotator.formats.kitti.tracking_folder import read_kitti_tracks
from annotator.workflows.importing.kitti import KittiLabels, labels_of


def read(path: Path) -> KittiLabels:
    """Raises FormatError as `read_kitti_tracks`."""
    return labels_of(path, *read_kitti_tracks(path))
