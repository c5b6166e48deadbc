"""`annotator project verify`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import AsJson, ProjectName, Projects
from annotator.cli.output import print_json, print_line
from annotator.cli.projects import named_folder
from annotator.project.backup.automatic import automatic_backups
from annotator.project.backup.verify import Verification, verify
from annotator.types.messages import amount

FAULTY = 1


def run(project: ProjectName, /, *, deep: bool = False, as_json: AsJson = False, projects: Projects = None) -> int:
    """Check whether a project is sound: its database, and that its tables are exactly those of its version.

    Nothing is changed, and a server may go on writing. The exit code is 1 if there are problems.

    Args:
        deep: also replay all events and compare, and check the hashes of all images and detectors.
    """
    folder = named_folder(project, projects)
    result = verify(folder, deep=deep)
    if result.problems or as_json:
        report_problems(result, folder, as_json)
    else:
        print_line(f"{project}: sound")
    return FAULTY if result.problems else 0


def report_problems(result: Verification, folder: Path, as_json: bool) -> None:
    """Prints the result of a verification of the project in `folder`."""
    if as_json:
        print_json(result)
        return
    for problem in result.problems:
        print_line(problem)
    print_line(f"{result.project}: {amount(len(result.problems), 'problem')}")
    newest = automatic_backups(folder)[-1:]
    where = f" such as {newest[0]}, the newest automatic one" if newest else ""
    print_line(f"`annotator project restore` restores a backup{where}; `annotator project repair` saves what it can")
