"""`project.json`: what a person may read and change with an editor."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, ValidationError

from annotator.files import write_atomic
from annotator.types.errors import ConfigError, ProjectError

CONFIG_FILE = "project.json"
FORMAT_VERSION = 1
NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


class BoxRotation(StrEnum):
    """Which rotations the project's boxes may have.

    AUTO: upright where the recording knows gravity, free elsewhere.
    """

    AUTO = "auto"
    UPRIGHT = "upright"
    FREE = "free"


def check_name(name: str) -> str:
    """`name` itself, where it may name a project (and so a folder on any system).

    Raises:
        ConfigError: it may not.
    """
    if not NAME_PATTERN.fullmatch(name):
        raise ConfigError(
            f"{name!r} is not a project name; use 1 to 64 of a-z, 0-9, _ and -, beginning with a letter or a digit"
        )
    return name


def _check_classes(classes: tuple[str, ...]) -> tuple[str, ...]:
    if not classes:
        raise ValueError("a project needs at least one class")
    for name in classes:
        if not name.isprintable() or name != name.strip() or not 0 < len(name) <= 64 or set(name) & set('/\\"'):
            raise ValueError(f"{name!r} cannot be a class name: 1 to 64 printable characters, no slashes or quotes")
    if len(set(classes)) < len(classes):
        raise ValueError(f"a class is named twice in {', '.join(classes)}")
    return classes


class ProjectSettings(BaseModel):
    """Defaults that the commands take where the command line says nothing.

    Attributes:
        rotation: which rotations boxes may have.
        rcv: settings of the recursion that differ from the defaults, groups as objects. The store only keeps them;
            whoever runs the recursion checks them (`annotator.workflows.rcv_settings`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rotation: BoxRotation = BoxRotation.AUTO
    rcv: dict[str, JsonValue] = Field(default_factory=dict)


class ProjectConfig(BaseModel):
    """The content of `project.json`.

    Attributes:
        name: the project's name; the folder may be moved or renamed.
        format_version: of this file.
        created_ns: when the project was created, UTC nanoseconds since the epoch.
        classes: the class names that boxes may have, in the detectors' order.
        settings: defaults for the commands.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    format_version: int = Field(FORMAT_VERSION, ge=1)
    created_ns: int = Field(ge=0)
    classes: Annotated[tuple[str, ...], AfterValidator(_check_classes)]
    settings: ProjectSettings = ProjectSettings()


def new_config(name: str, classes: tuple[str, ...], settings: ProjectSettings, created_ns: int) -> ProjectConfig:
    """The configuration of a new project.

    Raises:
        ConfigError: a name or a class that cannot be used.
    """
    check_name(name)
    try:
        return ProjectConfig(name=name, created_ns=created_ns, classes=classes, settings=settings)
    except ValidationError as error:
        raise ConfigError(f"project {name}: {_first_problem(error)}") from error


def read_config(folder: Path) -> ProjectConfig:
    """The configuration of the project in `folder`.

    Raises:
        ProjectError: no project, an unreadable file, or one written by a newer annotator.
    """
    path = folder / CONFIG_FILE
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        message = f"{folder} is not a project: it has no {CONFIG_FILE}; create one with `annotator new`"
        raise ProjectError(message) from error
    except OSError as error:
        raise ProjectError(f"{path}: cannot be read: {error}") from error
    try:
        version = _Version.model_validate_json(content).format_version
        if version > FORMAT_VERSION:
            raise ProjectError(
                f"{path}: has format version {version}, this annotator knows up to {FORMAT_VERSION}; update annotator"
            )
        return ProjectConfig.model_validate_json(content)
    except ValidationError as error:
        raise ProjectError(f"{path}: {_first_problem(error)}; repair it or restore it from a backup") from error


def write_config(folder: Path, config: ProjectConfig) -> None:
    """Write `project.json` in one step.

    Raises:
        ProjectError: it cannot be written.
    """
    path = folder / CONFIG_FILE
    try:
        write_atomic(path, (config.model_dump_json(indent=2) + "\n").encode())
    except OSError as error:
        raise ProjectError(f"{path}: cannot be written: {error}") from error


class _Version(BaseModel):
    """What every version of the file has, whatever else is in it."""

    format_version: int


def _first_problem(error: ValidationError) -> str:
    detail = error.errors()[0]
    where = ".".join(str(part) for part in detail["loc"])
    # pydantic's own prefix of what a validator of ours says
    problem = detail["msg"].removeprefix("Value error, ")
    return f"{where}: {problem}" if where else problem
