"""`annotator new`"""

from __future__ import annotations

from annotator.cli.output import print_line
from annotator.cli.projects import Root, projects_root
from annotator.project import BoxRotation, ProjectSettings, create_project


def run(name: str, /, *, classes: tuple[str, ...], rotation: BoxRotation = BoxRotation.AUTO, root: Root = None) -> None:
    """Create a project.

    Args:
        name: of the project, and of its folder.
        classes: what will be annotated, such as `hand`.
        rotation: which boxes the project makes: upright, free, or (auto) upright where a recording knows gravity.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    with create_project(projects_root(root), name, classes, settings=ProjectSettings(rotation=rotation)) as project:
        print_line(f"created {project.path} for {', '.join(project.config.classes)}")
        print_line(f"next: annotator add {name} PATH_OF_A_RECORDING")
