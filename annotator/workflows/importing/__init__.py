"""Imports labels for a project's frames: 3D boxes in one of the formats of `table.py`, and 2D boxes."""

from annotator.workflows.importing.boxes_2d import Imported, import_image_boxes, import_view_boxes
from annotator.workflows.importing.boxes_3d import ImportedLabels, import_labels
from annotator.workflows.importing.frame_finder import Renamed
from annotator.workflows.importing.image_boxes import Importer
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.picture_labels import FlatFormat
from annotator.workflows.importing.preview import Preview, preview
from annotator.workflows.importing.table import BoxFormat, read_labels

__all__ = [
    "BoxFormat",
    "FlatFormat",
    "Imported",
    "ImportedLabels",
    "Importer",
    "LabelSet",
    "Preview",
    "Renamed",
    "import_image_boxes",
    "import_labels",
    "import_view_boxes",
    "preview",
    "read_labels",
]
