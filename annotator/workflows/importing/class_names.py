"""The project's classes of a dataset's classes."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from annotator.project import Project
from annotator.types.errors import ConfigError
from annotator.types.names import alternatives

NO_NAMES: Mapping[str, str] = MappingProxyType({})


def renamed_class(label: str, names: Mapping[str, str]) -> str:
    """Returns the project's class of a dataset's class; classes that are not listed keep their names."""
    return names.get(label, label)


def class_names(text: str, project: Project) -> dict[str, str]:
    """Parses `Car=car,Pedestrian=person`: classes of a file, and the project's classes that they become.

    Raises:
        ConfigError: another form, a class that is there twice, or one that the project does not have.
    """
    names: dict[str, str] = {}
    for part in text.split(","):
        theirs, equals, ours = (word.strip() for word in part.rpartition("="))
        if not (equals and theirs and ours):
            raise ConfigError(f"--classes {text}: write CLASS_OF_THE_FILE=CLASS_OF_THE_PROJECT, separated by commas")
        if theirs in names:
            raise ConfigError(f"--classes {text}: {theirs} is there twice; keep one")
        if ours not in project.config.classes:
            others = alternatives(ours, project.config.classes)
            raise ConfigError(f"--classes {text}: the project has no class {ours!r}; {others}")
        names[theirs] = ours
    return names
