"""`annotator new`"""

from __future__ import annotations

from annotator.cli.options import Projects, Rotation, names_in, projects_root
from annotator.cli.output import print_line
from annotator.project import BoxRotation, ProjectSettings, create_project


def run(
    name: str,
    /,
    *,
    classes: tuple[str, ...],
    rotation: Rotation[BoxRotation] = BoxRotation.AUTO,
    projects: Projects = None,
) -> None:
    """Create a project.

    Args:
        name: name of the project and of its folder.
        classes: classes to annotate, such as `hand`; several with spaces or commas between them.
    """
    settings = ProjectSettings(rotation=rotation)
    with create_project(projects_root(projects), name, names_in(classes), settings=settings) as project:
        print_line(f"created {project.path} for {', '.join(project.config.classes)}")
        print_line(f"next: annotator add {name} PATH")
