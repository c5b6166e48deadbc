"""The `rcv` dataset: a folder of images, coloured point clouds and oriented boxes, after 3D_HUMAN and 3D_HAND.

The README.md that every export carries (readme.py) describes the folder; model.py is its JSON to the letter.
"""

from annotator.formats.rcv.export import RcvInfo, export_rcv
from annotator.formats.rcv.model import RcvDetector, RcvOptions
from annotator.formats.rcv.read import RcvDataset, RcvFrame, read_rcv

__all__ = [
    "RcvDataset",
    "RcvDetector",
    "RcvFrame",
    "RcvInfo",
    "RcvOptions",
    "export_rcv",
    "read_rcv",
]
