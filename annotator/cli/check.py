"""`annotator check`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.output import AsJson, print_json, print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named, projects_root
from annotator.project.config import CONFIG_FILE
from annotator.types.errors import ConfigError

FAULTY = 1


def run(what: str, /, *, project: bool = False, as_json: AsJson = False, root: Root = None) -> int:
    """Look for what is wrong: in a dataset (exit status 1 where there are errors), or with a project's labels.

    A dataset is checked by the rules of docs/checks.md: files, labels, boxes, calibration. A project's labels are
    looked through for odd sizes, empty boxes, heading jumps, duplicates and unknown classes.

    Args:
        what: path of a dataset (or of a folder of datasets), or a project's name.
        project: it is a project's name, also where a folder is called so.
        as_json: print one JSON object.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if project or not _is_dataset(what, root):
        _check_project(what, root, as_json)
        return 0
    return _check_dataset(Path(what), as_json)


def _is_dataset(what: str, root: Path | None) -> bool:
    """True for a path.

    Raises:
        ConfigError: it may be a project as well, or is the folder of one.
    """
    path = Path(what)
    is_name = len(path.parts) == 1 and not what.startswith(".")
    is_project = is_name and (projects_root(root) / what).is_dir()
    if path.exists() and is_project:
        raise ConfigError(f"{what} is a project and a path here; write ./{what}, or {what} --project")
    if (path / CONFIG_FILE).is_file():
        name, folder = path.resolve().name, path.resolve().parent
        raise ConfigError(f"{what} is the folder of a project; write annotator check {name} --root {folder}")
    return path.exists() or (not is_name and not is_project)


def _check_project(name: str, root: Path | None, as_json: bool) -> None:
    from annotator.workflows.checks import check_project

    with open_named(name, root) as opened:
        report = check_project(opened)
    if as_json:
        print_json(report)
        return
    for warning in report.warnings:
        print_line(f"{warning.recording} {warning.key}: {warning.kind}: {warning.message}")
    for line in report.unreadable:
        print_line(f"unreadable: {line}")
    print_line(f"{len(report.warnings)} warnings about {report.labels} labels")


def _check_dataset(path: Path, as_json: bool) -> int:
    from annotator.workflows.checking.check import check_datasets
    from annotator.workflows.checking.rules import Severity

    with counted("checking") as tell:
        report = check_datasets(path, tell)
    if as_json:
        print_json(report)
    else:
        for finding in report.findings:
            print_line(f"{finding.place}: {finding.severity} {finding.rule}: {finding.message}")
        for facts in report.datasets:
            print_line(f"{facts.path}: {facts.format}, {facts.frames} frames, {facts.labels} labels")
        print_line(", ".join(f"{report.counts[each]} {each}s" for each in Severity))
    return FAULTY if report.counts[Severity.ERROR] else 0
