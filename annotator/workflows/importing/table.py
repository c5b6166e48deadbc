"""The table of import formats of 3D boxes. A new format needs one row here and a reader in `formats_3d.py`."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

from annotator.workflows.importing import formats_3d
from annotator.workflows.importing.label_set import ProposalSet


class BoxFormat(StrEnum):
    """Formats of 3D boxes."""

    BOXES = "boxes"
    RCV = "rcv"
    KITTI = "kitti"
    KITTI_TRACKING = "kitti-tracking"
    SUNRGBD = "sunrgbd"
    OPENLABEL = "openlabel"
    LABELCLOUD = "labelcloud"
    NUSCENES = "nuscenes"
    SUSTECHPOINTS = "sustechpoints"
    ARGOVERSE2 = "argoverse2"
    BOX_CSV = "box-csv"


READERS: dict[BoxFormat, Callable[[Path], ProposalSet]] = {
    BoxFormat.RCV: formats_3d.rcv_labels,
    BoxFormat.KITTI: formats_3d.kitti_labels,
    BoxFormat.KITTI_TRACKING: formats_3d.kitti_tracking_labels,
    BoxFormat.SUNRGBD: formats_3d.sunrgbd_labels,
    BoxFormat.OPENLABEL: formats_3d.openlabel_labels,
    BoxFormat.LABELCLOUD: formats_3d.labelcloud_labels,
    BoxFormat.NUSCENES: formats_3d.nuscenes_labels,
    BoxFormat.SUSTECHPOINTS: formats_3d.sustechpoints_labels,
    BoxFormat.ARGOVERSE2: formats_3d.argoverse_labels,
    BoxFormat.BOX_CSV: formats_3d.box_csv_labels,
    BoxFormat.BOXES: formats_3d.boxes_labels,
}


def read_labels(format: BoxFormat, path: Path) -> ProposalSet:
    """Reads and checks all labels at `path`.

    Raises:
        FormatError: they do not follow the format.
    """
    return READERS[format](path)
