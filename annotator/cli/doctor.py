"""`annotator doctor`"""

from __future__ import annotations

from annotator.cli.options import AsJson, Projects
from annotator.cli.output import print_json, print_line
from annotator.cli.projects import projects_root

FAILED = 1


def run(*, as_json: AsJson = False, projects: Projects = None) -> int:
    """Examine this machine: packages, devices, disks and detector backends; run a self-test of a few seconds.

    Each backend runs a network with random weights, and the result is compared with that of torch on the CPU. Each
    line ends in ok, warning or failed; the exit code is 1 if any failed. The self-test leaves nothing on disk. The
    home folder is shown as ~, so that the output can be pasted into a bug report.
    """
    from annotator.workflows.doctor import as_text, examine

    report = examine(projects_root(projects))
    if as_json:
        print_json(report)
    else:
        for line in as_text(report):
            print_line(line)
    return FAILED if report.failed else 0
