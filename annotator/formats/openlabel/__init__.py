"""OpenLABEL (ASAM, 1.0.0): objects with fully oriented cuboids over the frames of a recording, as JSON.

model.py        the parts of a document that boxes need
shapes.py       cuboids, transforms and cameras in the standard's form
coordinates.py  transforms between the coordinate systems of a document
scene.py        builds the document of a recording
write.py        writes a folder of documents
read.py         reads documents
"""

from annotator.formats.openlabel.read import OpenLabelBox, OpenLabelFrame, read_openlabel
from annotator.formats.openlabel.write import write_openlabel

__all__ = ["OpenLabelBox", "OpenLabelFrame", "read_openlabel", "write_openlabel"]
