"""The table of import formats of 3D boxes. A new format needs one line here and one module in this folder."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from importlib import import_module
from pathlib import Path

from annotator.workflows.importing.label_set import LabelSet


class BoxFormat(StrEnum):
    """Formats of 3D boxes."""

    RCV = "rcv"
    KITTI = "kitti"
    KITTI_TRACKING = "kitti-tracking"
    SUNRGBD = "sunrgbd"
    OPENLABEL = "openlabel"
    LABELCLOUD = "labelcloud"
    NUSCENES = "nuscenes"


# The module in this folder with a function `read(path: Path) -> LabelSet`.
READERS: dict[BoxFormat, str] = {
    BoxFormat.RCV: "rcv",
    BoxFormat.KITTI: "kitti",
    BoxFormat.KITTI_TRACKING: "kitti_tracking",
    BoxFormat.SUNRGBD: "sunrgbd",
    BoxFormat.OPENLABEL: "openlabel",
    BoxFormat.LABELCLOUD: "labelcloud",
    BoxFormat.NUSCENES: "nuscenes",
}


def read_labels(format: BoxFormat, path: Path) -> LabelSet:
    """Reads and checks all labels at `path`.

    Raises:
        FormatError: they do not follow the format.
    """
    read: Callable[[Path], LabelSet] = import_module(f"annotator.workflows.importing.{READERS[format]}").read
    return read(path)
