"""The project's classes of a dataset's classes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType

from annotator.project import Project
from annotator.types.errors import ConfigError
from annotator.types.messages import alternatives, folded, nearest

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


def how_to_map(theirs: Collection[str], project: Project) -> str:
    """For messages: what to do about a dataset of which the project has no class."""
    ours = project.config.classes
    pairs = ((label, nearest(label, ours)) for label in sorted(theirs))
    label, near = next((pair for pair in pairs if pair[1] is not None), (min(theirs), None))
    meant = "" if near is None else f"did you mean {near!r}? "
    return (
        f"{meant}Map the classes to those of the project, as in --classes {label}={near or ours[0]}, or add them with "
        "`annotator classes add`"
    )


def without_effect(names: Mapping[str, str], present: Collection[str]) -> list[str]:
    """Returns a line for each class in `names` that a dataset does not have.

    Args:
        names: as `class_names` returns them.
        present: classes of the dataset's boxes.

    Raises:
        ConfigError: the dataset has such a class in another spelling only, which `names` does not have.
    """
    lines = []
    others = set(present) - names.keys()
    for theirs, ours in names.items():
        if theirs in present or not present:
            continue
        near = nearest(theirs, sorted(others))
        missing = f"the dataset has no class {theirs!r}" + ("" if near is None else f"; did you mean {near!r}?")
        if near is not None and folded(near) == folded(theirs):
            raise ConfigError(f"--classes {theirs}={ours}: {missing}")
        lines.append(f"--classes {theirs}={ours} has no effect: {missing}")
    return lines
