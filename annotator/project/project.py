"""A project: its folder, its settings and all that is stored in it."""

from __future__ import annotations

import shutil
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from sqlalchemy import Connection, select

from annotator.files import sync_folder
from annotator.project.boxes import Boxes, ImageBoxes, ViewBoxes, read_image_boxes, read_view_boxes
from annotator.project.config import (
    CONFIG_FILE,
    ProjectConfig,
    ProjectSettings,
    new_config,
    read_config,
    write_config,
)
from annotator.project.frames import Frames, StoredFrame, read_frame
from annotator.project.history import History
from annotator.project.jobs import Jobs
from annotator.project.labels import Labels, read_labels
from annotator.project.log import Log
from annotator.project.models import Models
from annotator.project.proposals import Proposals
from annotator.project.recordings import Recordings
from annotator.project.schema import labels
from annotator.project.statistics import Statistics, read_statistics
from annotator.project.store import BUSY_TIMEOUT_S, DATABASE_FILE, Clock, Store, create_store, open_store
from annotator.project.views import Views
from annotator.project.writing import Writer
from annotator.types import Label
from annotator.types.errors import ProjectError

MODELS_FOLDER, VIEWS_FOLDER = "models", "views"
_FOLDERS = (MODELS_FOLDER, VIEWS_FOLDER)


@dataclass(frozen=True, eq=False)
class FrameState:
    """All that is known of a frame at one moment; a change based on it names `frame.revision`."""

    frame: StoredFrame
    labels: tuple[Label, ...]
    image_boxes: ImageBoxes | None
    view_boxes: tuple[ViewBoxes, ...]


@dataclass(frozen=True)
class ListedProject:
    """A project found in a folder of projects: its configuration, or the problem that hides it."""

    path: Path
    config: ProjectConfig | None
    problem: str | None


class Project:
    """An open project; close it after use, or use it in a `with`.

    Threads may share it. Another process opens its own (never carry one over a fork).

    Attributes:
        path: the project's folder.
        recordings, frames, labels, proposals, boxes, views, jobs, models, log: what is stored, each with its methods.
        history: undo and redo.
    """

    def __init__(self, path: Path, store: Store) -> None:
        writer = Writer(store, path)
        self.path = path
        self.store = store
        self.views = Views(path / VIEWS_FOLDER)
        self.recordings = Recordings(store)
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
        """The configuration, read anew each time.

        Raises:
            ProjectError: `project.json` is missing or damaged.
        """
        return read_config(self.path)

    @property
    def models_folder(self) -> Path:
        """Where trained models and their data sets live."""
        return self.path / MODELS_FOLDER

    def configure(
        self, *, classes: Sequence[str] | None = None, settings: ProjectSettings | None = None
    ) -> ProjectConfig:
        """Change the classes or the settings; None leaves them.

        Raises:
            ConfigError: class names that cannot be used.
            ProjectError: a class that boxes have would go, or `project.json` cannot be written.
        """
        # the lock keeps two processes from changing the file at once, and boxes of a leaving class out
        with self.store.write() as connection:
            old = self.config
            wanted = old.classes if classes is None else tuple(classes)
            new = new_config(old.name, wanted, settings or old.settings, old.created_ns)
            if lost := sorted(_used_classes(connection) - set(new.classes)):
                raise ProjectError(
                    f"project {old.name}: {', '.join(map(repr, lost))} cannot go, there are boxes of this class; "
                    "keep the class, or delete or relabel its boxes first"
                )
            write_config(self.path, new)
        return new

    def frame_state(self, frame_id: int) -> FrameState:
        """Everything about one frame, as of one moment.

        Raises:
            NotFoundError: no such frame.
        """
        with self.store.read() as connection:
            return FrameState(
                read_frame(connection, frame_id),
                read_labels(connection, frame_id),
                read_image_boxes(connection, frame_id),
                read_view_boxes(connection, frame_id),
            )

    def statistics(self) -> Statistics:
        """How far the project is."""
        return read_statistics(self.store)

    def problems(self) -> list[str]:
        """What is wrong with the database when the whole of it is read; empty where all is well."""
        return self.store.problems()

    def close(self) -> None:
        """Close the database."""
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
    """A new project `root/name`; it appears complete, or not at all.

    Args:
        root: the folder of projects; made where it is missing.
        clock: gives the present, UTC nanoseconds since the epoch.

    Raises:
        ConfigError: a name or class that cannot be used.
        ProjectError: something of that name exists already, or the folder cannot be written.
    """
    config = new_config(name, tuple(classes), settings or ProjectSettings(), clock())
    path = root / name
    taken = f"{path} exists already; open it, or choose another name"
    if path.exists():
        raise ProjectError(taken)
    unfinished = root / f".{name}.{uuid.uuid4().hex}.unfinished"
    try:
        for folder in _FOLDERS:
            (unfinished / folder).mkdir(parents=True)
        create_store(unfinished / DATABASE_FILE, clock=clock).close()
        write_config(unfinished, config)
        unfinished.rename(path)
        sync_folder(root)
    except OSError as error:
        # another process was faster: a folder with content is never replaced
        raise ProjectError(taken if path.exists() else f"{path}: cannot be created: {error}") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return open_project(path, clock=clock)


def open_project(path: Path, *, busy_timeout_s: float = BUSY_TIMEOUT_S, clock: Clock = time.time_ns) -> Project:
    """The project in the folder `path`, its database brought to the newest version.

    Args:
        busy_timeout_s: how long to wait for another process that is writing, seconds.
        clock: gives the present, UTC nanoseconds since the epoch.

    Raises:
        ProjectError: no project, a damaged one, one of a newer annotator, or one that stays locked.
    """
    read_config(path)
    try:
        for folder in _FOLDERS:
            (path / folder).mkdir(exist_ok=True)
    except OSError as error:
        raise ProjectError(f"{path}: a folder of the project is missing and cannot be made: {error}") from error
    return Project(path, open_store(path / DATABASE_FILE, busy_timeout_s=busy_timeout_s, clock=clock))


def list_projects(root: Path) -> tuple[ListedProject, ...]:
    """The projects in a folder of projects, by name; a damaged one is listed with its problem."""
    if not root.is_dir():
        return ()
    return tuple(map(_listed, sorted(filter(_looks_like_project, root.iterdir()))))


def _looks_like_project(path: Path) -> bool:
    try:
        return not path.name.startswith(".") and (path / CONFIG_FILE).exists()
    except OSError:  # listed with what is wrong with it
        return True


def _listed(path: Path) -> ListedProject:
    try:
        return ListedProject(path, read_config(path), None)
    except ProjectError as error:
        return ListedProject(path, None, str(error))


def _used_classes(connection: Connection) -> set[str]:
    """Class names of the present 2D and 3D boxes."""
    on_pictures = "SELECT json_extract(box.value, '$.label') FROM {table}, json_each({table}.boxes) AS box"
    used = set(connection.execute(select(labels.c.label).distinct()).scalars())
    for table in ("image_labels", "view_labels"):
        used |= set(connection.exec_driver_sql(on_pictures.format(table=table)).scalars())
    return used
