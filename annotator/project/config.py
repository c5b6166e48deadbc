"""`project.json`: a project's name, classes and settings; it may be edited by hand."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, ValidationError

from annotator.files import write_atomic
from annotator.types.errors import RESTORE, ConfigError, ProjectError

CONFIG_FILE = "project.json"
FORMAT_VERSION = 1
NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


class BoxRotation(StrEnum):
    """Permitted rotations of the project's boxes.

    AUTO: upright in recordings with a known gravity direction, free in others.
    """

    AUTO = "auto"
    UPRIGHT = "upright"
    FREE = "free"


def check_name(name: str) -> str:
    """Returns `name` if it is a valid project name, and thus a valid folder name on any system.

    Raises:
        ConfigError: an invalid name.
    """
    if not NAME_PATTERN.fullmatch(name):
        raise ConfigError(
            f"{name!r} is not a valid project name; use 1 to 64 of a-z, 0-9, _ and -, with a letter or digit first"
        )
    return name


def _check_classes(classes: tuple[str, ...]) -> tuple[str, ...]:
    if not classes:
        raise ValueError("a project needs at least one class")
    for name in classes:
        if not name.isprintable() or name != name.strip() or not 0 < len(name) <= 64 or set(name) & set('/\\"'):
            raise ValueError(
                f"{name!r} is not a valid class name; use 1 to 64 printable characters without slashes or quotes"
            )
    if len(set(classes)) < len(classes):
        raise ValueError(f"class names must be unique, not {', '.join(classes)}")
    return classes


class ProjectSettings(BaseModel):
    """Defaults for options that are not given on the command line.

    Attributes:
        rotation: permitted rotations of boxes.
        rcv: settings of the recursion that differ from the defaults, groups as JSON objects. They are validated when
            the recursion is run (`annotator.workflows.settings`), not here.
        learn_every: while the page is open, a round of training in the background after so many more reviewed boxes;
            None: never.
        backup_hours: while a server runs, an automatic backup so many hours after the first change since the last one;
            None: never.
        backups_kept: number of automatic backups that are kept.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rotation: BoxRotation = BoxRotation.AUTO
    rcv: dict[str, JsonValue] = Field(default_factory=dict)
    learn_every: int | None = Field(None, ge=1)
    backup_hours: float | None = Field(4.0, gt=0.0)
    backups_kept: int = Field(5, ge=1, le=1000)


class ProjectConfig(BaseModel):
    """The content of `project.json`.

    Attributes:
        name: the project's name; moving or renaming the folder does not change it.
        format_version: of this file.
        created_ns: when the project was created, UTC nanoseconds since the epoch.
        classes: permitted class names of boxes, in the detectors' order.
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
        ConfigError: an invalid name or class.
    """
    check_name(name)
    try:
        return ProjectConfig(name=name, created_ns=created_ns, classes=classes, settings=settings)
    except ValidationError as error:
        raise ConfigError(f"project {name}: {_first_problem(error)}") from error


def read_config(folder: Path) -> ProjectConfig:
    """The configuration of the project in `folder`.

    Raises:
        ProjectError: no project, an unreadable file, or one of a newer version.
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
                f"{path}: has format version {version}; this annotator reads up to {FORMAT_VERSION}; update annotator"
            )
        return ProjectConfig.model_validate_json(content)
    except ValidationError as error:
        raise ProjectError(f"{path}: {_first_problem(error)}; repair it or {RESTORE}") from error


def write_config(folder: Path, config: ProjectConfig) -> None:
    """Writes `project.json` atomically.

    Raises:
        ProjectError: it cannot be written.
    """
    path = folder / CONFIG_FILE
    try:
        write_atomic(path, (config.model_dump_json(indent=2) + "\n").encode())
    except OSError as error:
        raise ProjectError(f"{path}: cannot be written: {error}") from error


class _Version(BaseModel):
    """The field that every version of the file has."""

    format_version: int


def _first_problem(error: ValidationError) -> str:
    detail = error.errors()[0]
    where = ".".join(str(part) for part in detail["loc"])
    # pydantic prefixes the messages of custom validators
    problem = detail["msg"].removeprefix("Value error, ")
    return f"{where}: {problem}" if where else problem
