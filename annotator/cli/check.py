"""`annotator check`"""

from __future__ import annotations

from annotator.cli.output import AsJson, print_json, print_line
from annotator.cli.projects import Root, open_named


def run(project: str, /, *, as_json: AsJson = False, root: Root = None) -> None:
    """List labels that look wrong: odd sizes, empty boxes, heading jumps, duplicates, unknown classes.

    Args:
        project: the project's name.
        as_json: print one JSON object.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    from annotator.workflows.checks import check_project

    with open_named(project, root) as opened:
        report = check_project(opened)
    if as_json:
        print_json(report)
        return
    for warning in report.warnings:
        print_line(f"{warning.recording} {warning.key}: {warning.kind}: {warning.message}")
    for line in report.unreadable:
        print_line(f"unreadable: {line}")
    print_line(f"{len(report.warnings)} warnings about {report.labels} labels")
