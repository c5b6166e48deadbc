"""A project: its folder, its settings and its database."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError
from sqlalchemy import Connection

from annotator.project.adjustments import Adjustments, Estimates
from annotator.project.audit.history import History
from annotator.project.backup.archive import MODELS_FOLDER, VIEWS_FOLDER, require_own_files
from annotator.project.backup.make import back_up_before_upgrade
from annotator.project.backup.snapshot import database_problems, new_project
from annotator.project.boxes import Boxes, Views
from annotator.project.classes.changing import MadeChange, made_changes, present_names, set_up_classes
from annotator.project.classes.changing import change_classes as change_rows
from annotator.project.classes.counts import ClassCounts, class_counts, value_counts
from annotator.project.classes.edit import ClassEdit, with_classes
from annotator.project.config import (
    CONFIG_FILE,
    ProjectConfig,
    ProjectSettings,
    mark_in_use,
    new_config,
    read_config,
    whole_config,
    write_config,
)
from annotator.project.database.store import DATABASE_FILE, Clock, Store, create_store, open_store, wal_of
from annotator.project.frames import Frames
from annotator.project.jobs import Jobs
from annotator.project.labels import Labels
from annotator.project.log import Writer
from annotator.project.models import Models
from annotator.project.progress.report import ReviewReader
from annotator.project.progress.statistics import Statistics, read_statistics
from annotator.project.proposals import Proposals
from annotator.project.recordings import Recordings
from annotator.project.rows import Terms
from annotator.project.stills import Stills
from annotator.types.errors import RESTORE, ConfigError, ProjectError
from annotator.types.messages import first_problem

AUTHOR = "annotator"


@dataclass(frozen=True)
class ListedProject:
    """One entry of a projects folder; `problem`: why it cannot be opened."""

    path: Path
    problem: str | None


class Project:
    """An open project; close it after use, or use it in a `with`.

    Thread-safe, but not fork-safe: each process opens its own.
    """

    def __init__(self, path: Path, store: Store, readable: Sequence[Path] | None = None) -> None:
        self.log = writer = Writer(store)
        self.path = path
        self.store = store
        self.views = Views(path / VIEWS_FOLDER)
        self.recordings = Recordings(store, None if readable is None else tuple(readable))
        self.adjustments = Adjustments(writer)
        self.estimates = Estimates(writer)
        self.frames = Frames(writer)
        self.labels = Labels(writer)
        self.stills = Stills(writer)
        self.proposals = Proposals(writer)
        self.boxes = Boxes(writer, self.views)
        self.jobs = Jobs(store)
        self.models = Models(store, path)
        self.history = History(writer)
        self._review = ReviewReader()
        self._in_use = mark_in_use(self, path)

    @property
    def config(self) -> ProjectConfig:
        """The settings, classes and attributes, read at each access: another process may have changed them."""
        with self.store.read() as connection:
            return self._config(connection)

    def _config(self, connection: Connection) -> ProjectConfig:
        try:
            return whole_config(read_config(self.path), Terms(connection))
        except ValidationError as error:
            raise ProjectError(
                f"{self.path}: its classes contradict each other: {first_problem(error)}; {RESTORE}"
            ) from error

    @property
    def models_folder(self) -> Path:
        """Folder of the trained models and their datasets."""
        return self.path / MODELS_FOLDER

    def configure(
        self, *, classes: Sequence[str] | None = None, settings: ProjectSettings | None = None, author: str = AUTHOR
    ) -> ProjectConfig:
        """Changes the classes or the settings; None leaves them as they are."""
        if classes is not None:  # first, since they may be refused
            self.change_classes(lambda old: ClassEdit("set the classes", with_classes(old, classes)), author)
        if settings is not None:
            with self.store.write():  # which prevents concurrent changes of the file
                write_config(self.path, read_config(self.path).model_copy(update={"settings": settings}))
        return self.config

    def change_classes(self, edit: Callable[[ProjectConfig], ClassEdit], author: str) -> ProjectConfig:
        """Changes the classes and attributes, with the boxes and values that follow; one action, which can be undone.

        Args:
            edit: one of `annotator.project.classes.edit`, applied to the present configuration.
        """
        # the lock prevents new boxes of a removed class
        with self.store.write() as connection:
            old = self._config(connection)
            try:
                made = edit(old)
            except ValidationError as error:
                raise ConfigError(first_problem(error)) from error
            if made.config != old or made.values:
                change_rows(self.store, connection, made, author)
            return made.config

    def class_changes(self, event_id: int) -> list[MadeChange]:
        """The changes of the classes after an event, in order."""
        with self.store.read() as connection:
            return made_changes(connection, event_id)

    def present_names(self, names: Sequence[str], time_ns: int) -> dict[str, str | None]:
        """Names of classes at a time (UTC nanoseconds) -> their present names; None for a removed class."""
        with self.store.read() as connection:
            return present_names(connection, names, time_ns)

    def value_counts(self) -> dict[str, dict[str, int]]:
        """How often each stored value of an attribute occurs, by attribute."""
        with self.store.read() as connection:
            return value_counts(connection)

    def class_counts(self) -> dict[str, ClassCounts]:
        """Numbers of boxes by class name, also of names that are no class of the project."""
        with self.store.read() as connection:
            return class_counts(connection)

    @property
    def is_current(self) -> bool:
        """False once the project's database was removed or replaced by another."""
        return self.store.file.is_current()

    def statistics(self) -> Statistics:
        """Counts of frames, labels and boxes, and the results of the review."""
        return read_statistics(self.store, self._review, self.config.attributes)

    def problems(self) -> list[str]:
        """Problems that a full check of the database finds; empty for a sound one."""
        return database_problems(self.store.path)

    def close(self) -> None:
        """Closes the database."""
        self.store.close()
        self._in_use()

    def __enter__(self) -> Project:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def create_project(
    root: Path,
    name: str,
    classes: Sequence[str],
    *,
    settings: ProjectSettings | None = None,
    clock: Clock = time.time_ns,
) -> Project:
    """Creates the project `root/name`; the folder appears complete or not at all."""
    config = new_config(name, tuple(classes), settings or ProjectSettings(), clock())
    with new_project(root, name) as place:
        store = create_store(place / DATABASE_FILE, clock=clock)
        try:
            with store.write() as connection:
                set_up_classes(store, connection, config, AUTHOR)
        finally:
            store.close()
        write_config(place, config)
    return open_project(root / name, clock=clock)


def open_project(path: Path, *, clock: Clock = time.time_ns, readable: Sequence[Path] | None = None) -> Project:
    """Opens the project in the folder `path`; an older database is backed up, and upgraded to the newest version.

    Args:
        readable: folders in which its recordings may lie; None = anywhere.
    """
    read_config(path)
    require_own_files(path)
    _require_fitting_wal(path / DATABASE_FILE)
    store = open_store(path / DATABASE_FILE, clock=clock, before_upgrade=lambda: back_up_before_upgrade(path))
    project = Project(path, store, readable)
    try:
        project.models.all()  # refuses paths of other folders
        if os.access(path, os.W_OK):  # a project on a read-only disk can be read without this
            for folder in (MODELS_FOLDER, VIEWS_FOLDER):
                (path / folder).mkdir(exist_ok=True)
    except BaseException as error:
        project.close()
        if isinstance(error, OSError):
            raise ProjectError(f"{path}: a subfolder cannot be created: {error}") from error
        raise
    return project


def _require_fitting_wal(database: Path) -> None:
    """Refuses a database that was put beside the `-wal` of another state, if they are not sound together.

    A kill leaves that file, and SQLite applies it to the database that it finds there, also to an older copy.
    """
    with suppress(OSError):  # opening it says what is wrong
        wal = wal_of(database).stat()
        if wal.st_size == 0 or database.stat().st_ctime_ns < wal.st_ctime_ns:  # else a checkpoint, or somebody's copy
            return
        if problems := database_problems(database):
            raise ProjectError(
                f"{database}: with the file {wal_of(database).name} beside it, {problems[0]}; if the database was put "
                "there by hand, that file is of another state. Nothing was changed. `annotator project repair` makes a "
                f"new project of what can be read; or {RESTORE}"
            )


def list_projects(root: Path) -> tuple[ListedProject, ...]:
    """The projects in a projects folder, sorted by name; a damaged one is listed with its problem."""
    try:
        return tuple(map(_listed, sorted(filter(_looks_like_project, root.iterdir()))))
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except OSError as error:
        raise ProjectError(f"{root}: cannot be read: {error.strerror}; check the permissions of the folder") from error


def _looks_like_project(path: Path) -> bool:
    try:
        return not path.name.startswith(".") and (path / CONFIG_FILE).exists()
    except OSError:  # `_listed` reports the problem
        return True


def _listed(path: Path) -> ListedProject:
    try:
        read_config(path)
        return ListedProject(path, None)
    except ProjectError as error:
        return ListedProject(path, str(error))
