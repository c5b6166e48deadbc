"""The `rcv` dataset: a folder of images, coloured point clouds and oriented boxes, modelled on 3D_HUMAN and 3D_HAND.

readme.py writes the README.md that describes the folder; model.py defines its JSON.
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
