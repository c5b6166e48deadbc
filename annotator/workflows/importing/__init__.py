"""Imports labels for a project's frames: 3D boxes in one of the formats of `table.py`, and 2D boxes."""

from annotator.workflows.importing.boxes_2d import Imported, import_image_boxes, import_view_boxes
from annotator.workflows.importing.boxes_3d import ImportedLabels, ImportedProposals, import_labels, import_proposals
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.pictures import FlatFormat
from annotator.workflows.importing.placing import Importer, Renamed, class_names, without_effect
from annotator.workflows.importing.preview import Preview, Preview3D, preview, preview_3d
from annotator.workflows.importing.table import BoxFormat, format_of, read_labels

__all__ = [
    "BoxFormat",
    "FlatFormat",
    "Imported",
    "ImportedLabels",
    "ImportedProposals",
    "Importer",
    "LabelSet",
    "Preview",
    "Preview3D",
    "Renamed",
    "class_names",
    "format_of",
    "import_image_boxes",
    "import_labels",
    "import_proposals",
    "import_view_boxes",
    "preview",
    "preview_3d",
    "read_labels",
    "without_effect",
]
