"""A project: its folder, its settings and its database."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from sqlalchemy import Connection, select

from annotator.files import private_folder, sync_folder
from annotator.project.adjusting.adjustments import Adjustments
from annotator.project.backup.automatic import back_up_before_upgrade
from annotator.project.backup.content import MODELS_FOLDER, VIEWS_FOLDER
from annotator.project.backup.unfinished import unfinished_folder
from annotator.project.boxes import Boxes
from annotator.project.config import (
    CONFIG_FILE,
    ProjectConfig,
    ProjectSettings,
    new_config,
    read_config,
    write_config,
)
from annotator.project.frames import Frames
from annotator.project.history import History
from annotator.project.jobs import Jobs
from annotator.project.labels import Labels
from annotator.project.log import Log
from annotator.project.models import Models
from annotator.project.proposals import Proposals
from annotator.project.recordings import Recordings
from annotator.project.schema import labels
from annotator.project.statistics import Statistics, read_statistics
from annotator.project.store import BUSY_TIMEOUT_S, DATABASE_FILE, Clock, Store, create_store, open_store
from annotator.project.views import Views
from annotator.project.writing import Writer
from annotator.types.errors import ProjectError

_FOLDERS = (MODELS_FOLDER, VIEWS_FOLDER)


@dataclass(frozen=True)
class ListedProject:
    """One entry of a projects folder: its configuration, or why it cannot be opened."""

    path: Path
    config: ProjectConfig | None
    problem: str | None


class Project:
    """An open project; close it after use, or use it in a `with`.

    Thread-safe, but not fork-safe: each process opens its own.

    Attributes:
        path: the project's folder.
        recordings, adjustments, frames, labels, proposals, boxes, views, jobs, models, log: access to the stored data.
        history: undo and redo.
    """

    def __init__(self, path: Path, store: Store) -> None:
        writer = Writer(store, path)
        self.path = path
        self.store = store
        self.views = Views(path / VIEWS_FOLDER)
        self.recordings = Recordings(store)
        self.adjustments = Adjustments(writer)
        self.frames = Frames(writer)
        self.labels = Labels(writer)
        self.proposals = Proposals(writer)
        self.boxes = Boxes(writer, self.views)
        self.jobs = Jobs(store)
        self.models = Models(store, path)
        self.log = Log(writer)
        self.history = History(writer)

    @property
    def config(self) -> ProjectConfig:
        """The configuration, read from the file at each access.

        Raises:
            ProjectError: `project.json` is missing or damaged.
        """
        return read_config(self.path)

    @property
    def models_folder(self) -> Path:
        """Folder of the trained models and their datasets."""
        return self.path / MODELS_FOLDER

    def configure(
        self, *, classes: Sequence[str] | None = None, settings: ProjectSettings | None = None
    ) -> ProjectConfig:
        """Changes the classes or the settings; None leaves them as they are.

        Raises:
            ConfigError: invalid class names.
            ProjectError: boxes have a class that would be removed, or `project.json` cannot be written.
        """
        # the lock prevents concurrent changes of the file, and new boxes of a removed class
        with self.store.write() as connection:
            old = self.config
            names = old.classes if classes is None else tuple(classes)
            new = new_config(old.name, names, settings or old.settings, old.created_ns)
            if removed := sorted(_used_classes(connection) - set(new.classes)):
                raise ProjectError(
                    f"project {old.name}: {', '.join(map(repr, removed))} cannot be removed while boxes use it; "
                    "delete or relabel these boxes first"
                )
            write_config(self.path, new)
        return new

    def statistics(self) -> Statistics:
        """Counts of frames, labels and boxes, and the results of the review."""
        return read_statistics(self.store)

    def problems(self) -> list[str]:
        """Problems that a full check of the database finds; empty for a sound one."""
        return self.store.problems()

    def close(self) -> None:
        """Closes the database."""
        self.store.close()

    def __enter__(self) -> Project:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def create_project(
    root: Path,
    name: str,
    classes: Sequence[str],
    *,
    settings: ProjectSettings | None = None,
    clock: Clock = time.time_ns,
) -> Project:
    """Creates the project `root/name`; the folder appears complete or not at all.

    Args:
        root: the projects folder; created if missing.
        clock: returns the current time, UTC nanoseconds since the epoch.

    Raises:
        ConfigError: an invalid name or class.
        ProjectError: the path exists already, or the folder cannot be written.
    """
    config = new_config(name, tuple(classes), settings or ProjectSettings(), clock())
    path = root / name
    taken = f"{path} exists already; open it, or choose another name"
    if path.exists():
        raise ProjectError(taken)
    try:
        with unfinished_folder(root, name) as unfinished:
            private_folder(unfinished)
            for folder in _FOLDERS:
                (unfinished / folder).mkdir()
            create_store(unfinished / DATABASE_FILE, clock=clock).close()
            write_config(unfinished, config)
            unfinished.rename(path)
            sync_folder(root)
    except OSError as error:
        # `rename` never replaces a folder with content: another process may have created the project meanwhile
        raise ProjectError(taken if path.exists() else f"{path}: cannot be created: {error}") from error
    return open_project(path, clock=clock)


def open_project(path: Path, *, busy_timeout_s: float = BUSY_TIMEOUT_S, clock: Clock = time.time_ns) -> Project:
    """Opens the project in the folder `path`; an older database is backed up, and upgraded to the newest version.

    Args:
        busy_timeout_s: how long to wait while another process writes, seconds.
        clock: returns the current time, UTC nanoseconds since the epoch.

    Raises:
        ProjectError: no project, a damaged one, one of a newer version, or one that stays locked.
    """
    read_config(path)
    try:
        for folder in _FOLDERS:
            (path / folder).mkdir(exist_ok=True)
    except OSError as error:
        raise ProjectError(f"{path}: a subfolder ({', '.join(_FOLDERS)}) cannot be created: {error}") from error
    store = open_store(
        path / DATABASE_FILE,
        busy_timeout_s=busy_timeout_s,
        clock=clock,
        before_upgrade=lambda _: back_up_before_upgrade(path),
    )
    return Project(path, store)


def list_projects(root: Path) -> tuple[ListedProject, ...]:
    """The projects in a projects folder, sorted by name; a damaged one is listed with its problem."""
    if not root.is_dir():
        return ()
    return tuple(map(_listed, sorted(filter(_looks_like_project, root.iterdir()))))


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


def _used_classes(connection: Connection) -> set[str]:
    """Class names of the stored 2D and 3D boxes."""
    on_images = "SELECT json_extract(box.value, '$.label') FROM {table}, json_each({table}.boxes) AS box"
    used = set(connection.execute(select(labels.c.label).distinct()).scalars())
    for table in ("image_labels", "view_labels"):
        used |= set(connection.exec_driver_sql(on_images.format(table=table)).scalars())
    return used
