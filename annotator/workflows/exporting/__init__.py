"""Exports the labels of a project as a dataset in one of the formats of `annotator/formats/table.py`."""

from annotator.formats.table import WRITERS, ExportFormat
from annotator.workflows.exporting.choose import ExportFilter, Split, SplitBy, parse_shares
from annotator.workflows.exporting.export import export_project
from annotator.workflows.exporting.job import ExportOptions, ExportReport
