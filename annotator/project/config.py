"""A project's folder, and its `project.json`: name and settings, which may be edited by hand."""

from __future__ import annotations

import os
import re
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, Field, JsonValue, ValidationError, model_validator

from annotator.files import lock_folder, private_folder, read_file, sync_folder, write_atomic
from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.project.rows import Terms
from annotator.text import is_within
from annotator.types import BoxKind
from annotator.types.bases import Strict
from annotator.types.errors import RESTORE, ConfigError, InUseError, ProjectError
from annotator.types.messages import first_problem

CONFIG_FILE = "project.json"
BACKUPS = ".backups"  # folder of automatic backups, beside the projects
FORMAT_VERSION = 2
NAME_PATTERN = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")


class BoxRotation(StrEnum):
    """Permitted rotations of the project's boxes.

    AUTO: upright in recordings with a known gravity direction, free in others.
    """

    AUTO = "auto"
    UPRIGHT = "upright"
    FREE = "free"


def check_name(name: str) -> str:
    """Returns `name` if it is a valid project name, and thus a valid folder name on any system."""
    if not NAME_PATTERN.fullmatch(name):
        raise ConfigError(
            f"{name!r} is not a valid project name; use 1 to 64 of a-z, 0-9, _ and -, with a letter or digit first"
        )
    return name


TAKEN = "{} exists already; choose another name"


def free_path(root: Path, name: str) -> Path:
    """The folder of a new project of that name in the projects folder `root`."""
    path = root / check_name(name)
    if os.path.lexists(path):
        raise ProjectError(TAKEN.format(path))
    return path


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


def _require_different(names: list[str], problem: str) -> None:
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"{problem} {twice[0]!r}; each must have its own")


class ProjectSettings(Strict):
    """Defaults for options that are not given on the command line.

    Attributes:
        box_kind: what the 2D boxes enclose that people draw on images.
        rcv: settings of the recursion that differ from the defaults. They are validated when
            the recursion is run (`annotator.workflows.settings`), not here.
        learn_every: while the page is open, a round of training in the background after so many more reviewed boxes;
            None: never.
        learn_minutes: length of such a round.
        backup_hours: while a server runs, an automatic backup so many hours after the first change since the last one;
            None: never.
    """

    rotation: BoxRotation = BoxRotation.AUTO
    box_kind: BoxKind = BoxKind.SILHOUETTE
    rcv: dict[str, JsonValue] = Field(default_factory=dict)
    learn_every: int | None = Field(None, ge=1)
    learn_minutes: float = Field(3.0, gt=0.0)
    backup_hours: float | None = Field(4.0, gt=0.0)
    backups_kept: int = Field(5, ge=1, le=1000)


class ProjectFile(Strict):
    """The content of `project.json`; `name`: moving or renaming the folder does not change it."""

    name: str
    format_version: int = Field(FORMAT_VERSION, ge=1)
    created_ns: int = Field(ge=0)
    settings: ProjectSettings = ProjectSettings()


class ProjectConfig(ProjectFile):
    """The settings of a project, and its classes and attributes, which are rows of the database.

    Attributes:
        classes: permitted class names of boxes, in the detectors' order.
        class_styles: colours and keys of classes; a class without an entry has those by default.
    """

    classes: Annotated[tuple[str, ...], AfterValidator(_check_classes)]
    class_styles: dict[str, ClassStyle] = Field(default_factory=dict)
    attributes: tuple[Attribute, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> ProjectConfig:
        names = [attribute.name for attribute in self.attributes]
        _require_different(names, "two attributes have the name")
        keys = [*(style.key for style in self.class_styles.values()), *(each.key for each in self.attributes)]
        _require_different([key for key in keys if key is not None], "two classes or attributes have the key")
        used = {*self.class_styles, *(name for attribute in self.attributes for name in attribute.classes)}
        if unknown := sorted(used - set(self.classes)):
            known = ", ".join(self.classes)
            raise ValueError(
                f"class_styles or attributes name the class {unknown[0]!r}, which is not in classes ({known})"
            )
        return self


def new_config(name: str, classes: tuple[str, ...], settings: ProjectSettings, created_ns: int) -> ProjectConfig:
    """The configuration of a new project."""
    check_name(name)
    try:
        return ProjectConfig(name=name, created_ns=created_ns, classes=classes, settings=settings)
    except ValidationError as error:
        raise ConfigError(f"project {name}: {first_problem(error)}") from error


def read_config(folder: Path) -> ProjectFile:
    """The `project.json` of the project in `folder`."""
    path = folder / CONFIG_FILE
    try:
        if path.is_symlink() and not is_within(folder, path):
            raise ProjectError(f"{path}: is a link that leads out of the project; put the file in its place")
        content = read_file(path)
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError) as error:
        message = f"{folder} is not a project: it has no {CONFIG_FILE}; create one with `annotator new`"
        raise ProjectError(message) from error
    except OSError as error:
        raise ProjectError(f"{path}: cannot be read: {error}") from error
    try:
        version = _Version.model_validate_json(content).format_version
        if version == FORMAT_VERSION:
            return ProjectFile.model_validate_json(content)
    except ValidationError as error:
        raise ProjectError(f"{path}: {first_problem(error)}; repair it or {RESTORE}") from error
    remedy = "update annotator" if version > FORMAT_VERSION else "use the version that made it"
    raise ProjectError(f"{path}: has format version {version}, but this annotator reads {FORMAT_VERSION}; {remedy}")


def write_config(folder: Path, config: ProjectFile) -> None:
    """Writes `project.json` atomically."""
    path = folder / CONFIG_FILE
    content = config.model_dump_json(indent=2, include=set(ProjectFile.model_fields))
    try:
        write_atomic(path, f"{content}\n".encode())
    except OSError as error:
        raise ProjectError(f"{path}: cannot be written: {error}") from error


def whole_config(file: ProjectFile, terms: Terms) -> ProjectConfig:
    """The settings of a project with the classes and attributes of a transaction.

    Raises:
        ValidationError: these contradict each other.
    """
    schema = {"classes": terms.classes, "class_styles": terms.styles, "attributes": terms.attributes}
    return ProjectConfig.model_validate(dict(file) | schema)


class _Version(BaseModel):
    """The field that every version of the file has."""

    format_version: int


# --- the folder: in use, renamed, set aside ---------------------------------------------------------------------------


def mark_in_use(opened: object, folder: Path) -> Callable[[], object]:
    """Marks the project in `folder` as open until the returned function is called, or `opened` is gone.

    Waits while another process renames or removes it. Without locks, as on Windows and some network disks, nothing is
    marked.
    """
    lock = lock_folder(folder, is_shared=True, waits=True)
    return weakref.finalize(opened, lock.close)


@contextmanager
def not_in_use(folder: Path) -> Iterator[None]:
    """In the block, nobody has the project in `folder` open."""
    try:
        lock = lock_folder(folder, is_told=True)
    except BlockingIOError:
        raise InUseError(
            f"{folder}: another process has this project open; if it is a server, use its start page, or stop it; "
            "if it is a command, wait until it is done"
        ) from None
    with lock:
        yield


# Renaming and setting aside are one rename, which other processes notice: the store refuses to write to a database that
# is no longer at its place (`database/store.py`).
REMOVED, REMOVED_AT = ".removed", "%Y%m%dT%H%M%S%fZ"


def set_aside(project: Path) -> Path:
    """Moves a project, which may be damaged, into the folder `.removed` beside it; returns its new folder."""
    removed = project.parent / REMOVED
    stamp = datetime.now(UTC).strftime(REMOVED_AT)
    aside = removed / f"{project.name}-{stamp}"
    try:
        with not_in_use(project):
            if not removed.exists():
                private_folder(removed)
            project.rename(aside)
        sync_folder(removed)
        sync_folder(project.parent)
    except OSError as error:
        raise ProjectError(f"{project}: cannot be moved to {removed}: {error.strerror}") from error
    return aside


@dataclass(frozen=True)
class Removed:
    """A removed project: its folder now, its name, and when it was removed."""

    path: Path
    name: str
    at: datetime


def removed_projects(root: Path) -> list[Removed]:
    """The removed projects of a projects folder, the newest first."""
    found = []
    with suppress(OSError):  # nothing was removed yet, or the folder is not ours to read
        for path in (root / REMOVED).iterdir():
            name, _, stamp = path.name.rpartition("-")
            with suppress(ValueError):  # not from here
                at = datetime.strptime(stamp, REMOVED_AT).replace(tzinfo=UTC)
                if name and path.is_dir():
                    found.append(Removed(path, name, at))
    return sorted(found, key=lambda each: each.at, reverse=True)


def take_back(removed: Removed) -> Path:
    """Moves a removed project back to the other projects; returns its folder."""
    path = free_path(removed.path.parent.parent, removed.name)
    try:
        # never replaces a folder with content, which another process may have made meanwhile
        removed.path.rename(path)
        sync_folder(removed.path.parent)
        sync_folder(path.parent)
    except OSError as error:
        raise ProjectError(f"{removed.path}: cannot be moved to {path}: {error.strerror}") from error
    return path


def rename_project(project: Path, name: str) -> str:
    """Gives a project and the folder of its automatic backups another name, which it returns."""
    read_config(project)
    path = free_path(project.parent, name)
    try:
        with not_in_use(project):
            # never replaces a folder with content, which another process may have made meanwhile
            project.rename(path)
            # nobody has it open; the folder's name counts, and a project with an old name in its settings is whole
            write_config(path, read_config(path).model_copy(update={"name": name}))
        sync_folder(project.parent)
        backups, renamed = (project.parent / BACKUPS / each for each in (project.name, name))
        if backups.is_dir() and not renamed.exists():
            backups.rename(renamed)
    except OSError as error:
        raise ProjectError(f"{project}: cannot be renamed to {name}: {error.strerror}") from error
    return name
