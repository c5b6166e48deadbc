"""A project: its folder, its settings and its database."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection

from annotator.project.adjustments import Adjustments
from annotator.project.audit.history import History
from annotator.project.backup.archive import MODELS_FOLDER, VIEWS_FOLDER, require_own_files
from annotator.project.backup.make import Reason, back_up_automatically, back_up_before_upgrade
from annotator.project.backup.snapshot import database_problems, new_project
from annotator.project.boxes import Boxes, Views
from annotator.project.classes.attributes import Relabelling
from annotator.project.classes.changing import MadeChange, made_changes
from annotator.project.classes.changing import change_classes as change_rows
from annotator.project.classes.counts import ClassCounts, class_counts, require_fitting, value_counts
from annotator.project.classes.edit import ClassEdit, with_classes
from annotator.project.config import (
    CONFIG_FILE,
    ProjectConfig,
    ProjectSettings,
    mark_in_use,
    new_config,
    prepare_config,
    read_config,
    take_config,
    write_config,
)
from annotator.project.database.store import DATABASE_FILE, Clock, Store, create_store, open_store, wal_of
from annotator.project.frames import Frames
from annotator.project.jobs import Jobs
from annotator.project.labels import Labels
from annotator.project.log import Writer
from annotator.project.models import Models
from annotator.project.progress.report import ReviewReader
from annotator.project.proposals import Proposals
from annotator.project.recordings import Recordings
from annotator.project.statistics import Statistics, read_statistics
from annotator.types.errors import RESTORE, ProjectError

AUTHOR = "annotator"


@dataclass(frozen=True)
class ListedProject:
    """One entry of a projects folder: its configuration, or why it cannot be opened."""

    path: Path
    config: ProjectConfig | None
    problem: str | None


class Project:
    """An open project; close it after use, or use it in a `with`.

    Thread-safe, but not fork-safe: each process opens its own.
    """

    def __init__(self, path: Path, store: Store, readable: Sequence[Path] | None = None) -> None:
        self.log = writer = Writer(store, path)
        self.path = path
        self.store = store
        self.views = Views(path / VIEWS_FOLDER)
        self.recordings = Recordings(store, None if readable is None else tuple(readable))
        self.adjustments = Adjustments(writer)
        self.frames = Frames(writer)
        self.labels = Labels(writer)
        self.proposals = Proposals(writer)
        self.boxes = Boxes(writer, self.views)
        self.jobs = Jobs(store)
        self.models = Models(store, path)
        self.history = History(writer)
        self._review = ReviewReader()
        self._in_use = mark_in_use(self, path)

    @property
    def config(self) -> ProjectConfig:
        """The configuration, read from the file at each access."""
        return read_config(self.path)

    @property
    def models_folder(self) -> Path:
        """Folder of the trained models and their datasets."""
        return self.path / MODELS_FOLDER

    def configure(
        self, *, classes: Sequence[str] | None = None, settings: ProjectSettings | None = None, author: str = AUTHOR
    ) -> ProjectConfig:
        """Changes the classes or the settings; None leaves them as they are."""

        def edited(old: ProjectConfig) -> ClassEdit:
            new = old if classes is None else with_classes(old, classes)
            return ClassEdit(new.model_copy(update={"settings": settings or old.settings}))

        return self.change_classes(edited, author)

    def change_classes(self, edit: Callable[[ProjectConfig], ClassEdit], author: str) -> ProjectConfig:
        """Changes the classes and attributes, with the labels that follow; one event of the project.

        Args:
            edit: one of `annotator.project.classes.edit`, applied to the present configuration.
        """
        # the lock prevents concurrent changes of the file, and new boxes of a removed class
        with self.store.write() as connection:
            old = take_config(self.path, connection)
            made = edit(old)
            new = made.config
            if (number := self._change_classes(connection, old, made, author)) is not None:
                prepare_config(self.path, new, number)
            elif new != old:
                write_config(self.path, new)
        with self.store.read() as connection:
            return take_config(self.path, connection)

    def _change_classes(self, connection: Connection, old: ProjectConfig, made: ClassEdit, author: str) -> int | None:
        new = made.config
        is_same = all(getattr(new, name) == getattr(old, name) for name in ("classes", "class_styles", "attributes"))
        if is_same and made.change == Relabelling():
            return None
        number = change_rows(self.log, connection, old, new, made.change, author)
        gone = set(old.classes) - set(new.classes)
        if used := sorted(gone & class_counts(connection, removed=True).keys()) if gone else []:
            raise ProjectError(
                f"project {old.name}: {', '.join(map(repr, used))} cannot be removed while boxes use it; give them "
                "another class (--into on the command line), or remove them, too (--with-boxes); recordings that "
                "were removed may have some"
            )
        require_fitting(connection, old.attributes, new.attributes)
        return number

    def class_changes(self, event_id: int = 0) -> list[MadeChange]:
        """The changes of the classes after an event, in order."""
        with self.store.read() as connection:
            return made_changes(connection, event_id)

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


def change_classes(
    project: Project, edit: Callable[[ProjectConfig], ClassEdit], author: str
) -> tuple[ProjectConfig, Path | None]:
    """Changes the classes as `Project.change_classes`.

    Undo does not revert it. The opposite change does, except for what the backup is made for.

    Returns:
        the new configuration, and the backup that was made before, if any.
    """
    old = project.config
    made = edit(old)
    # boxes may also have names that are no classes of the project
    names = {*old.classes, *project.class_counts()} if made.change.classes else set[str]()
    backup = back_up_automatically(project.path, Reason.CLASSES).path if _loses(old, made, names) else None
    return project.change_classes(edit, author), backup


def _loses(old: ProjectConfig, made: ClassEdit, names: set[str]) -> bool:
    """Whether boxes (of the classes `names`) or values are removed, or cannot be told apart afterwards."""
    change = made.change
    choices = {each.name: each.choices for each in old.attributes}
    return (
        bool(change.removed or change.dropped or change.fitted)
        or any(new in names for new in change.classes.values())
        or any(new in choices[name] for name, renamed in change.choices.items() for new in renamed.values())
    )


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
        create_store(place / DATABASE_FILE, clock=clock).close()
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
            with store.read() as connection:
                take_config(path, connection)
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
        return ListedProject(path, read_config(path), None)
    except ProjectError as error:
        return ListedProject(path, None, str(error))
