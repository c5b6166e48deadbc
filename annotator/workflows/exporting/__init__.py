"""Exports the labels of a project as a dataset in one of the formats of `table.py`."""

from annotator.workflows.exporting.choose import ExportFilter, Split, SplitBy, parse_shares
from annotator.workflows.exporting.export import export_project
from annotator.workflows.exporting.job import ExportOptions, ExportReport
from annotator.workflows.exporting.table import WRITERS, ExportFormat

__all__ = [
    "WRITERS",
    "ExportFilter",
    "ExportFormat",
    "ExportOptions",
    "ExportReport",
    "Split",
    "SplitBy",
    "export_project",
    "parse_shares",
]
