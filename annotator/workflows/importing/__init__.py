"""Labels from elsewhere onto a project's frames: 3D boxes in one of the formats of `table.py`, 2D boxes."""

from annotator.workflows.importing.boxes_3d import ImportedLabels, import_labels
from annotator.workflows.importing.label_set import LabelSet
from annotator.workflows.importing.table import BoxFormat, read_labels

__all__ = ["BoxFormat", "ImportedLabels", "LabelSet", "import_labels", "read_labels"]
