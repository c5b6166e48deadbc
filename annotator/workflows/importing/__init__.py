"""Imports boxes for a project's frames: any format is read, placed on frames and stored, with one report.

label_set.py  3D boxes in any format; readers.py reads them
pictures.py   2D boxes in any format
placing.py    the project's frames and classes of a dataset's
boxes_3d.py, boxes_2d.py, values.py  what is stored
report.py     what an import tells: of a file before it is imported, and the report after it
"""

from annotator.formats.table import BoxFormat, FlatFormat, format_of
from annotator.workflows.importing.boxes_2d import import_image_boxes, import_view_boxes
from annotator.workflows.importing.boxes_3d import import_labels, import_proposals
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.placing import Importer, without_effect
from annotator.workflows.importing.readers import read_labels
from annotator.workflows.importing.report import Become, ImportReport, Note, Preview, preview_boxes
