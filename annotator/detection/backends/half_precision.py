"""What stays in single precision where OpenVINO computes a network in half: what scores and edges come from.

OpenVINO keeps what follows the last convolutions as it is, and layers that are marked as precise. With what is
done here edges are off by a third as much, and scores by two thirds, in next to no more time
(docs/detector_backends.md).
"""

from __future__ import annotations

import logging
import re
from typing import Any
from xml.etree import ElementTree

from annotator.detection.ultralytics_api import api

LOG = logging.getLogger("annotator.detectors")

# As OpenVINO names it in its files, in a layer's `rt_info`.
PRECISE = {"name": "precise", "version": "0"}
# Activations and biases go with the convolution that they follow. They are not marked themselves: activations of the
# whole network share a name, since ultralytics has one module for all of them.
CONVOLUTIONS = ("Convolution", "GroupConvolution")
# A layer's name begins with its place in the module; the detecting layer's edges are `cv2`, scale by scale, two
# convolutions and the last one. Its first two are the most expensive ones of that layer.
HALF_IN_HEAD = r"(?:one2one_)?cv2\.\d+\.[01]\."


def sum_up_edges(module: Any) -> None:
    """Has a raw network's detecting layer find the expected distance of an edge by a sum in place of a convolution.

    A convolution with fixed weights is the same, but OpenVINO would compute it, and the shares before it, in half
    precision.
    """
    torch = api().torch
    head = module.model.model[-1]
    if not hasattr(head.dfl, "c1"):  # an answer is a distance by itself, as in YOLO26
        return

    class Expected(torch.nn.Module):  # type: ignore[name-defined]
        def __init__(self, bins: int) -> None:
            super().__init__()
            self.bins = bins
            self.register_buffer("distances", torch.arange(bins, dtype=torch.float32).view(1, 1, bins, 1))

        def forward(self, logits: Any) -> Any:
            pictures, _, anchors = logits.shape
            shares = logits.view(pictures, 4, self.bins, anchors).softmax(2)
            return (shares * self.distances).sum(2)

    head.dfl = Expected(head.dfl.c1)


def marked(network: bytes, head: int) -> bytes:
    """OpenVINO's XML of a network with its precise layers marked.

    Where they are named in another way, as a later version may, nothing is marked and the log says so: in single
    precision the network is the same without.

    Args:
        network: content of its XML file.
        head: the detecting layer's number in the module.
    """
    root = ElementTree.fromstring(network)
    in_head = re.compile(rf"__module\.model\.model\.{head}\.(?!{HALF_IN_HEAD})")
    found = [
        layer
        for layer in root.iterfind("layers/layer")
        if layer.get("type") in CONVOLUTIONS and in_head.match(layer.get("name", ""))
    ]
    if not found:
        LOG.warning("the detecting layer is not found in OpenVINO's file; in bfloat16 its boxes are less exact")
        return network
    for layer in found:
        facts = layer.find("rt_info")
        if facts is None:
            facts = ElementTree.SubElement(layer, "rt_info")
        ElementTree.SubElement(facts, "attribute", PRECISE)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
