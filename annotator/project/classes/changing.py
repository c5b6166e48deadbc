"""Changes of the classes by people: a project is backed up before a change that no other one brings back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from annotator.project.backup.make import Reason, back_up_automatically
from annotator.project.classes.edit import ClassEdit
from annotator.project.config import ProjectConfig
from annotator.project.project import Project


@dataclass(frozen=True)
class Changed:
    """The new configuration, and the backup that was made before, if any."""

    config: ProjectConfig
    backup: Path | None


def change_classes(project: Project, edit: Callable[[ProjectConfig], ClassEdit], author: str) -> Changed:
    """Changes the classes as `Project.change_classes`.

    Undo does not revert it. The opposite change does, except for what the backup is made for.

    Raises:
        ConfigError, NotFoundError, ProjectError: as `Project.change_classes`, or it cannot be backed up.
    """
    old = project.config
    made = edit(old)
    # boxes may also have names that are no classes of the project
    names = {*old.classes, *project.class_counts()} if made.change.classes else set[str]()
    backup = back_up_automatically(project.path, Reason.CLASSES).path if _loses(old, made, names) else None
    return Changed(project.change_classes(edit, author), backup)


def _loses(old: ProjectConfig, made: ClassEdit, names: set[str]) -> bool:
    """Whether boxes (of the classes `names`) or values are removed, or cannot be told apart afterwards."""
    change = made.change
    choices = {each.name: each.choices for each in old.attributes}
    return (
        bool(change.removed or change.dropped or change.fitted)
        or any(new in names for new in change.classes.values())
        or any(new in choices[name] for name, renamed in change.choices.items() for new in renamed.values())
    )
