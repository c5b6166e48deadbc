"""`annotator check`"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from annotator.cli.options import AsJson, Projects, place_of
from annotator.cli.output import counted, print_result
from annotator.cli.project import report_problems
from annotator.project import open_project
from annotator.types.messages import amount

FAULTY = 1
UNREADABLE = "unreadable"
# Findings of one kind that are printed without --all.
MOST_OF_A_KIND = 5


def run(
    what: str,
    /,
    *,
    list_all: Annotated[bool, arg(name="all", help="list every finding, not only the first few of each kind.")] = False,
    as_json: AsJson = False,
    projects: Projects = None,
) -> int:
    """Find errors in a dataset, or suspicious labels in a project.

    A dataset is checked by the rules of docs/checks.md: files, labels, boxes, calibration; the exit code is 1 if there
    are errors. A project is verified first (as by `annotator project verify --deep`; 1 if it is not sound). Its labels
    are then checked for odd sizes, empty boxes, heading jumps, duplicates, contradicting tracks, unknown classes, and
    missing or wrong values of attributes (1 if recordings or frames cannot be read).

    Args:
        what: name or folder of a project, path of a dataset, or path of a folder of datasets.
    """
    place, is_project = place_of(what, projects)
    return (_check_project if is_project else _check_dataset)(place, list_all, as_json)


def _check_project(folder: Path, list_all: bool, as_json: bool) -> int:
    from annotator.project.backup.verify import verify
    from annotator.workflows.checking.project_labels import check_project

    verification = verify(folder, deep=True)
    if verification.problems:
        report_problems(verification, folder, as_json)
        return FAULTY
    with open_project(folder) as project:
        report = check_project(project)
    lines = [(w.kind.value, f"{w.recording} {w.key}: {w.kind}: {w.message}") for w in report.warnings]
    lines += [(UNREADABLE, f"{UNREADABLE}: {line}") for line in report.unreadable]
    unread = amount(len(report.unreadable), "recording or frame", "recordings or frames")
    summary = f"{amount(len(report.warnings), 'warning')}; {amount(report.labels, 'label')} checked"
    summary += f"; {unread} could not be read" if report.unreadable else ""
    print_result(report, (*_grouped(lines, list_all), summary), as_json)
    return FAULTY if report.unreadable else 0


def _grouped(lines: Sequence[tuple[str, str]], list_all: bool) -> Iterator[str]:
    """Yields the first lines of each kind, in their order, and how many more there are; lines are kind and text."""
    seen: Counter[str] = Counter()
    for kind, line in lines:
        seen[kind] += 1
        if list_all or seen[kind] <= MOST_OF_A_KIND:
            yield line
    for kind, total in sorted(seen.items()):
        if not list_all and total > MOST_OF_A_KIND:
            yield f"{kind}: {total - MOST_OF_A_KIND} more like these; --all lists them"


def _check_dataset(path: Path, list_all: bool, as_json: bool) -> int:
    from annotator.workflows.checking.dataset_check import check_datasets
    from annotator.workflows.checking.findings import Severity

    with counted("checking") as progress:
        report = check_datasets(path, progress)
    found = [(f.rule, f"{f.place}: {f.severity} {f.rule}: {f.message}") for f in report.findings]
    lines = [*_grouped(found, list_all)]
    for each in report.datasets:
        only = "" if each.labels else ", so only its files were checked"
        counts = f"{amount(each.frames, 'frame')}, {amount(each.labels, 'label')}"
        lines.append(f"{each.path}: {each.format}, {counts}{only}")
    lines.append(", ".join(amount(report.counts[each], each) for each in Severity))
    print_result(report, lines, as_json)
    return FAULTY if report.counts[Severity.ERROR] else 0
