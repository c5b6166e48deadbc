"""`annotator doctor`"""

from __future__ import annotations

from annotator.cli.options import AsJson, Projects, projects_root
from annotator.cli.output import print_result

FAILED = 1


def run(*, as_json: AsJson = False, projects: Projects = None) -> int:
    """Examine this machine: packages, devices, disks and detector backends; run a self-test of a few seconds.

    Each backend runs a network with random weights, and the result is compared with that of torch on the CPU. Each
    line ends in ok, warning or failed; the exit code is 1 if any failed. The self-test leaves nothing on disk. The
    home folder is shown as ~, so that the output can be pasted into a bug report.
    """
    from annotator.workflows.doctor import as_text, examine

    report = examine(projects_root(projects))
    print_result(report, as_text(report), as_json)
    return FAILED if report.failed else 0
