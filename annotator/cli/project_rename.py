"""`annotator project rename`"""

from __future__ import annotations

from annotator.cli.options import ProjectName, Projects, named_folder
from annotator.cli.output import print_line
from annotator.project.tidying.folders import rename_project


def run(project: ProjectName, new_name: str, /, *, projects: Projects = None) -> None:
    """Rename a project and its folder. Its automatic backups go with it.

    Args:
        new_name: the new name.
    """
    print_line(f"renamed {project} to {rename_project(named_folder(project, projects), new_name)}")
