"""`annotator check`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import AsJson, Projects
from annotator.cli.output import print_json, print_line
from annotator.cli.progress import counted
from annotator.cli.project_verify import report_problems
from annotator.cli.projects import named_folder, open_named, projects_root
from annotator.project.config import CONFIG_FILE
from annotator.types.errors import ConfigError

FAULTY = 1


def run(
    what: str | None = None, /, *, project: str | None = None, as_json: AsJson = False, projects: Projects = None
) -> int:
    """Find errors in a dataset, or suspicious labels in a project.

    A dataset is checked by the rules of docs/checks.md: files, labels, boxes, calibration; the exit code is 1 if there
    are errors. A project is verified first (as by `annotator project verify --deep`; 1 if it is not sound). Its labels
    are then checked for odd sizes, empty boxes, heading jumps, duplicates and unknown classes.

    Args:
        what: path of a dataset, path of a folder of datasets, or name of a project.
        project: name of a project; needed only if a folder has the same name.
    """
    name = what if project is None else project
    if name is None or (what is not None and project is not None):
        raise ConfigError("name one thing to check: annotator check PATH, or annotator check --project NAME")
    if project is None and _is_dataset(name, projects):
        return _check_dataset(Path(name), as_json)
    return _check_project(name, projects, as_json)


def _is_dataset(what: str, projects: Path | None) -> bool:
    """Whether `what` is the path of a dataset, not the name of a project.

    Raises:
        ConfigError: both a project and a path have this name, or the path is the folder of a project.
    """
    path = Path(what)
    is_name = len(path.parts) == 1 and not what.startswith(".")
    is_project = is_name and (projects_root(projects) / what).is_dir()
    if path.exists() and is_project:
        raise ConfigError(f"{what} is both a project and a path; write ./{what} or --project {what}")
    if (path / CONFIG_FILE).is_file():
        name, folder = path.resolve().name, path.resolve().parent
        raise ConfigError(f"{what} is the folder of a project; write annotator check {name} --projects {folder}")
    return path.exists() or (not is_name and not is_project)


def _check_project(name: str, projects: Path | None, as_json: bool) -> int:
    from annotator.project.backup.verify import verify
    from annotator.workflows.checking.project_labels import check_project

    verification = verify(named_folder(name, projects), deep=True)
    if verification.problems:
        report_problems(verification, as_json)
        return FAULTY
    with open_named(name, projects) as opened:
        report = check_project(opened)
    if as_json:
        print_json(report)
        return 0
    for warning in report.warnings:
        print_line(f"{warning.recording} {warning.key}: {warning.kind}: {warning.message}")
    for line in report.unreadable:
        print_line(f"unreadable: {line}")
    print_line(f"{len(report.warnings)} warnings about {report.labels} labels")
    return 0


def _check_dataset(path: Path, as_json: bool) -> int:
    from annotator.workflows.checking.check import check_datasets
    from annotator.workflows.checking.rules import Severity

    with counted("checking") as progress:
        report = check_datasets(path, progress)
    if as_json:
        print_json(report)
    else:
        for finding in report.findings:
            print_line(f"{finding.place}: {finding.severity} {finding.rule}: {finding.message}")
        for facts in report.datasets:
            print_line(f"{facts.path}: {facts.format}, {facts.frames} frames, {facts.labels} labels")
        print_line(", ".join(f"{report.counts[each]} {each}s" for each in Severity))
    return FAULTY if report.counts[Severity.ERROR] else 0
