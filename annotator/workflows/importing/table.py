"""The table of import formats of 3D boxes. A new format needs one row here and a function in `readers/`."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path

from annotator.formats.units import AngleUnit, Lengths
from annotator.types.errors import ConfigError
from annotator.workflows.importing.label_set import ProposalSet
from annotator.workflows.importing.readers import frame_boxes, reviewed_boxes, surround_boxes


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


def _nuscenes(path: Path) -> ProposalSet:
    return surround_boxes.nuscenes_results(path) if path.is_file() else frame_boxes.nuscenes_tables(path)


READERS: dict[BoxFormat, Callable[[Path], ProposalSet]] = {
    BoxFormat.RCV: reviewed_boxes.rcv_labels,
    BoxFormat.SUNRGBD: frame_boxes.sunrgbd_labels,
    BoxFormat.NUSCENES: _nuscenes,
    BoxFormat.ARGOVERSE2: surround_boxes.argoverse_labels,
    BoxFormat.BOXES: frame_boxes.boxes_labels,
}
# The formats that write angles, and their readers, which take the unit; None: as the format says.
WITH_ANGLES: dict[BoxFormat, Callable[[Path, AngleUnit | None], ProposalSet]] = {
    BoxFormat.KITTI: frame_boxes.kitti_labels,
    BoxFormat.KITTI_TRACKING: frame_boxes.kitti_tracking_labels,
    BoxFormat.OPENLABEL: reviewed_boxes.openlabel_labels,
    BoxFormat.LABELCLOUD: frame_boxes.labelcloud_labels,
    BoxFormat.SUSTECHPOINTS: frame_boxes.sustechpoints_labels,
    BoxFormat.BOX_CSV: frame_boxes.box_csv_labels,
}


def read_labels(format: BoxFormat, path: Path, angles: AngleUnit | None = None) -> ProposalSet:
    """Reads and checks all labels at `path`.

    Args:
        angles: unit of the angles, if it is not what the format says, or if the labels do not show it.

    Raises:
        FormatError: they do not follow the format.
        UnitError: they cannot be in the units that the format has.
        ConfigError: `angles` for a format without angles.
    """
    if format in WITH_ANGLES:
        dataset = WITH_ANGLES[format](path, angles)
    elif angles is not None:
        raise ConfigError(f"{format} has no angles; leave out --angles (it is for {', '.join(WITH_ANGLES)})")
    else:
        dataset = READERS[format](path)
    Lengths(dataset.sizes_m).require(path)
    return dataset
