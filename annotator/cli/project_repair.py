"""`annotator project repair`"""

from __future__ import annotations

from annotator.cli.options import ProjectName, Projects
from annotator.cli.output import print_line
from annotator.cli.project_backup import print_missing
from annotator.cli.projects import named_folder
from annotator.project.backup.repair import repair
from annotator.types.messages import amount


def run(project: ProjectName, new_name: str | None = None, /, *, projects: Projects = None) -> None:
    """Repair a project: make its present state anew from its events, after a backup.

    If the database is damaged, all that can be read goes into a new project, and the damaged one stays as it is.

    Args:
        new_name: name of the new project, if one is needed; default: the old name with `-repaired`.
    """
    done = repair(named_folder(project, projects), new_name)
    events = amount(done.events, "event")
    if not done.is_new:
        print_line(f"{done.path}: its state was made anew from {events}; backed up before: {done.backup}")
        print_missing(done.missing)
        return
    print_line(f"{done.path}: a new project with {events}; the damaged project is unchanged")
    if done.lost:
        lost = ", ".join(amount(count, table.removesuffix("s")) for table, count in sorted(done.lost.items()))
        print_line(f"missing, unreadable or unusable: {lost}; compare with the newest backup")
    if done.restored:
        print_line(f"taken from the damaged tables, because their events are lost: {amount(done.restored, 'state')}")
    print_missing(done.missing)
