"""OpenLABEL (ASAM, 1.0.0): objects with fully oriented cuboids over the frames of a recording, as JSON.

model.py        the parts of a document that boxes need
shapes.py       cuboids, transforms and cameras as the standard writes them
coordinates.py  from one coordinate system of a document to another
scene.py        a recording as a document; write.py: a folder of them
read.py         documents of ours and of others
"""

from annotator.formats.openlabel.read import OpenLabelBox, OpenLabelFrame, read_openlabel
from annotator.formats.openlabel.write import write_openlabel

__all__ = ["OpenLabelBox", "OpenLabelFrame", "read_openlabel", "write_openlabel"]
