"""`annotator project verify`"""

from __future__ import annotations

from annotator.cli.options import AsJson, ProjectName, Projects
from annotator.cli.output import print_json, print_line
from annotator.cli.projects import named_folder
from annotator.project.backup.verify import Verification, verify
from annotator.types.amounts import amount

FAULTY = 1


def run(project: ProjectName, /, *, deep: bool = False, as_json: AsJson = False, projects: Projects = None) -> int:
    """Check whether a project is sound: its database, and that its tables are exactly those of its version.

    Nothing is changed, and a server may go on writing. The exit code is 1 if there are problems.

    Args:
        deep: also replay all events and compare, and check the hashes of all images.
    """
    result = verify(named_folder(project, projects), deep=deep)
    if result.problems or as_json:
        report_problems(result, as_json)
    else:
        print_line(f"{project}: sound")
    return FAULTY if result.problems else 0


def report_problems(result: Verification, as_json: bool) -> None:
    """Prints the result of a verification that has found problems."""
    if as_json:
        print_json(result)
        return
    for problem in result.problems:
        print_line(problem)
    print_line(f"{result.project}: {amount(len(result.problems), 'problem')}")
    print_line("`annotator project restore` restores a backup, `annotator project repair` saves what it can")
