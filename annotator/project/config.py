"""A project's folder, and its `project.json`: name, classes and settings, which may be edited by hand."""

from __future__ import annotations

import hashlib
import os
import re
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, Field, JsonValue, ValidationError, model_serializer, model_validator
from sqlalchemy import Connection, select

from annotator.files import lock_folder, private_folder, read_file, sync_folder, write_atomic
from annotator.project.classes.attributes import Attribute, ClassStyle
from annotator.project.database.schema import class_changes
from annotator.text import is_within
from annotator.types.bases import Strict
from annotator.types.errors import RESTORE, ConfigError, InUseError, ProjectError
from annotator.types.messages import first_problem

CONFIG_FILE = "project.json"
BACKUPS = ".backups"  # folder of automatic backups, beside the projects
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
        rcv: settings of the recursion that differ from the defaults. They are validated when
            the recursion is run (`annotator.workflows.settings`), not here.
        learn_every: while the page is open, a round of training in the background after so many more reviewed boxes;
            None: never.
        backup_hours: while a server runs, an automatic backup so many hours after the first change since the last one;
            None: never.
    """

    rotation: BoxRotation = BoxRotation.AUTO
    rcv: dict[str, JsonValue] = Field(default_factory=dict)
    learn_every: int | None = Field(None, ge=1)
    backup_hours: float | None = Field(4.0, gt=0.0)
    backups_kept: int = Field(5, ge=1, le=1000)


class ProjectConfig(Strict):
    """The content of `project.json`.

    Attributes:
        name: the project's name; moving or renaming the folder does not change it.
        classes: permitted class names of boxes, in the detectors' order.
        class_styles: colours and keys of classes; a class without an entry has those by default.
    """

    name: str
    format_version: int = Field(FORMAT_VERSION, ge=1)
    created_ns: int = Field(ge=0)
    classes: Annotated[tuple[str, ...], AfterValidator(_check_classes)]
    class_styles: dict[str, ClassStyle] = Field(default_factory=dict)
    attributes: tuple[Attribute, ...] = ()
    settings: ProjectSettings = ProjectSettings()

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

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        unused = [name for name in ("class_styles", "attributes") if not getattr(self, name)]
        return {name: value for name, value in handler(self).items() if name not in unused}

    def attributes_of(self, label: str) -> tuple[Attribute, ...]:
        """The attributes of a class's boxes and tracks."""
        return tuple(attribute for attribute in self.attributes if attribute.is_of(label))


def new_config(name: str, classes: tuple[str, ...], settings: ProjectSettings, created_ns: int) -> ProjectConfig:
    """The configuration of a new project."""
    check_name(name)
    try:
        return ProjectConfig(name=name, created_ns=created_ns, classes=classes, settings=settings)
    except ValidationError as error:
        raise ConfigError(f"project {name}: {first_problem(error)}") from error


def read_config(folder: Path) -> ProjectConfig:
    """The configuration of the project in `folder`."""
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
        if version <= FORMAT_VERSION:
            return ProjectConfig.model_validate_json(content)
    except ValidationError as error:
        raise ProjectError(f"{path}: {first_problem(error)}; repair it or {RESTORE}") from error
    raise ProjectError(
        f"{path}: has format version {version}; this annotator reads up to {FORMAT_VERSION}; update annotator"
    )


def config_bytes(config: ProjectConfig) -> bytes:
    """The content of `project.json`."""
    return (config.model_dump_json(indent=2) + "\n").encode()


def write_config(folder: Path, config: ProjectConfig, name: str = CONFIG_FILE) -> Path:
    """Writes `project.json` (or the file that is to take its place) atomically; returns its path."""
    path = folder / name
    try:
        write_atomic(path, config_bytes(config))
    except OSError as error:
        raise ProjectError(f"{path}: cannot be written: {error}") from error
    return path


class _Version(BaseModel):
    """The field that every version of the file has."""

    format_version: int


# --- changes of `project.json` together with the database -------------------------------------------------------------
# Both have the old classes or both the new ones, also after a kill. The new file is written beside the old one before
# the transaction ends, under a name with the number of its change. Afterwards it takes the old one's place. After a
# kill, the next process looks for that change: if the table has it, the transaction has ended well, and the new file
# counts; otherwise it is removed.

_PREPARED = f"{CONFIG_FILE}.change-"


def config_hash(config: ProjectConfig) -> str:
    """SHA-256 (hex) of a configuration's file."""
    return hashlib.sha256(config_bytes(config)).hexdigest()


def prepare_config(folder: Path, config: ProjectConfig, number: int) -> Path:
    """Writes the configuration that counts once the transaction of a change has ended; returns its file."""
    return write_config(folder, config, f"{_PREPARED}{number}")


def take_config(folder: Path, connection: Connection) -> ProjectConfig:
    """The project's configuration, after a prepared one has taken its place, or was dropped."""
    for path in sorted(folder.glob(f"{_PREPARED}*")):
        try:
            if _counts(path, connection):
                path.replace(folder / CONFIG_FILE)
                sync_folder(folder)
            else:
                path.unlink()
        except FileNotFoundError:  # another process was faster
            continue
        except OSError as error:
            raise ProjectError(f"{path}: cannot take the place of {CONFIG_FILE}: {error}") from error
    return read_config(folder)


def _counts(path: Path, connection: Connection) -> bool:
    """Whether the table has the change, and not another one with its number, of a transaction that came later."""
    number = path.name.removeprefix(_PREPARED)
    if not number.isdecimal():
        return False
    query = select(class_changes.c.config).where(class_changes.c.id == int(number))
    return connection.execute(query).scalar() == hashlib.sha256(read_file(path)).hexdigest()


# --- the folder: in use, renamed, set aside ---------------------------------------------------------------------------


def mark_in_use(opened: object, folder: Path) -> Callable[[], object]:
    """Marks the project in `folder` as open until the returned function is called, or `opened` is gone.

    Waits while another process renames or removes it. Without locks, as on Windows and some network disks, nothing is
    marked.
    """
    lock = lock_folder(folder, is_shared=True, waits=True)
    return (lambda: None) if lock is None else weakref.finalize(opened, os.close, lock)


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
    try:
        yield
    finally:
        if lock is not None:
            os.close(lock)


# Renaming and setting aside are one rename, which other processes notice: the store refuses to write to a database that
# is no longer at its place (`database/store.py`).
REMOVED = ".removed"


def set_aside(project: Path) -> Path:
    """Moves a project, which may be damaged, into the folder `.removed` beside it; returns its new folder."""
    removed = project.parent / REMOVED
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%fZ")
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
