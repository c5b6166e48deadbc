"""Making a new project of a backup, of another one, or of the folder that somebody else has sent."""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

from sqlalchemy import insert, select, true

from annotator.files import CHUNK_BYTES, sync_folder
from annotator.project.adjustments import Adjustments
from annotator.project.backup.archive import (
    MODELS_FOLDER,
    VIEWS_FOLDER,
    BackupManifest,
    ModelChoice,
    Progress,
    is_regular,
    keep_models,
    open_backup,
    unpack,
)
from annotator.project.backup.snapshot import copied_files, database_problems, unfinished_folder, write_snapshot
from annotator.project.backup.verify import verify
from annotator.project.config import CONFIG_FILE, check_name, free_path, read_config, write_config
from annotator.project.database.file import wal_of
from annotator.project.database.schema import class_changes, frames, models, recordings
from annotator.project.database.store import DATABASE_FILE, Store, create_store, open_store
from annotator.project.log import Writer
from annotator.project.recordings import KEPT, Recordings
from annotator.types.errors import FormatError, ProjectError
from annotator.types.messages import amount

# --- a copy without labels --------------------------------------------------------------------------------------------

AUTHOR = "annotator project copy"


def remove_labels(database: Path) -> None:
    """Replaces a copied database, which nobody has open, by one that has no labels, boxes and passes.

    Removed recordings and frames that are no longer there are left out. Ids stay.

    Raises:
        ProjectError: it is damaged, or the disk is full.
        OSError: the file cannot be written.
    """
    empty = database.with_name(f"{database.name}.unlabelled")
    with closing(open_store(database)) as old, closing(create_store(empty)) as new:
        _copy_rows(old, new)
        _copy_adjustments(old, new)
    empty.replace(database)


def _copy_rows(old: Store, new: Store) -> None:
    with old.read() as source, new.write() as target:
        for table, there in (
            (recordings, recordings.c.removed_ns.is_(None)),
            (frames, KEPT & frames.c.position.is_not(None)),
            (models, true()),
            # detectors that were trained before a class was renamed need them
            (class_changes, true()),
        ):
            unlabelled = {"revision": 0, "finalised": False, "attributes": None} if table is frames else {}
            rows = [{**row, **unlabelled} for row in source.execute(select(table).where(there)).mappings()]
            if rows:
                target.execute(insert(table), rows)


def _copy_adjustments(old: Store, new: Store) -> None:
    """Makes each adjustment anew, as an event without the labels that the first one moved."""
    adjustments = Adjustments(Writer(new, new.path.parent))
    for recording in Recordings(old).all():
        if not recording.adjusted or not recording.frames:
            continue
        adjustments.correct(recording.id, recording.correction, AUTHOR)
        if Recordings(new).get(recording.id).up != recording.up:
            adjustments.set_up(recording.id, recording.up, AUTHOR)


# Windows has neither of the last two, nor links and pipes as others have them.
_FLAGS = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def restore(
    file: Path, root: Path, name: str | None = None, progress: Progress = lambda done, total: None
) -> tuple[Path, BackupManifest]:
    """Makes the project `root/name` of a backup; the folder appears complete and checked, or not at all.

    Args:
        name: of the new project; default: that of the backup.

    Returns:
        The project's folder, and the backup's manifest.

    Raises:
        ConfigError: an invalid name.
        FormatError: the file is damaged, or not a backup.
        ProjectError: the name is taken, the database is damaged, or the folder cannot be written.
    """
    with open_backup(file) as (archive, manifest):
        name = check_name(manifest.project if name is None else name)
        with new_project(root, name) as place:
            unpack(file, archive, place, progress)
            if problems := database_problems(place / DATABASE_FILE):
                raise FormatError(file, f"{DATABASE_FILE}: {problems[0]}")
    return root / name, manifest


def copy_project(
    folder: Path,
    root: Path,
    name: str,
    models: ModelChoice = ModelChoice.ALL,
    progress: Progress = lambda done, total: None,
    *,
    labels: bool = True,
    sent: bool = True,
) -> Path:
    """Makes the project `root/name` of the project in `folder`, which nobody needs to trust; returns its folder.

    Only the regular files that a project consists of are copied: no links, caches or converted networks. The copy is
    verified before it gets its name.

    Args:
        labels: False for a copy with the recordings and detectors only.
        sent: False for a project of one's own, which other processes may be writing to.

    Raises:
        ConfigError: an invalid name.
        ProjectError: not a project, something is wrong with it, the name is taken, or the copy cannot be written.
    """
    check_name(name)
    for required in (CONFIG_FILE, DATABASE_FILE):
        if not is_regular(folder, required):
            raise ProjectError(
                f"{folder} is not a project that can be copied: {required} is missing or no regular file"
            )
    read_config(folder)  # which bounds its size
    with new_project(root, name) as place:
        database = place / DATABASE_FILE
        if sent:
            _take_database(folder, place)
        else:
            write_snapshot(folder / DATABASE_FILE, database)
        if problems := database_problems(database):
            raise ProjectError(f"{folder / DATABASE_FILE}: {problems[0]}")
        if not labels:
            remove_labels(database)
        keep_models(database, models)
        names, _ = copied_files(folder, database)
        copy_files(folder, place, names, progress)
        if found := verify(place, deep=True).problems:
            more = f" (and {amount(len(found) - 1, 'more problem')})" if len(found) > 1 else ""
            raise ProjectError(f"{folder}: {found[0]}{more}; nothing was copied")
    return root / name


def _take_database(folder: Path, place: Path) -> None:
    """Copies a foreign database before SQLite sees it: opening one can write to its folder."""
    copied = place / "copied"
    copied.mkdir()
    for part in (DATABASE_FILE, wal_of(Path(DATABASE_FILE)).name):
        if is_regular(folder, part):
            _copy_regular(folder / part, copied / part)
    write_snapshot(copied / DATABASE_FILE, place / DATABASE_FILE)
    shutil.rmtree(copied)


@contextmanager
def new_project(root: Path, name: str) -> Iterator[Path]:
    """Yields a hidden folder for the content of a project, which becomes `root/name` if the block succeeds.

    Raises:
        ProjectError: the name is taken, or the folder cannot be written.
    """
    path = free_path(root, name)
    try:
        with unfinished_folder(root, name) as place:
            yield place
            for folder in (MODELS_FOLDER, VIEWS_FOLDER):
                (place / folder).mkdir(exist_ok=True)
            write_config(place, read_config(place).model_copy(update={"name": name}))
            _sync_files(place)
            # never replaces a folder with content, which another process may have made meanwhile
            place.rename(path)
            sync_folder(root)
    except OSError as error:
        raise ProjectError(f"{path}: cannot be created: {error}") from error


def _sync_files(folder: Path) -> None:
    """Makes the new files in a folder durable: all at once, which is much faster for thousands of small files."""
    if hasattr(os, "sync"):
        os.sync()
        return
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb+") as file:
                os.fsync(file.fileno())


def copy_files(source: Path, target: Path, names: Sequence[str], progress: Progress) -> None:
    """Copies regular files of a project into the folder of a new one."""
    for number, name in enumerate(names, 1):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        _copy_regular(source / name, target / name)
        progress(number, len(names))


def _copy_regular(source: Path, target: Path) -> None:
    # it may have been replaced by a link or a pipe since it was listed
    with os.fdopen(os.open(source, _FLAGS), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(f"{source} is not a regular file")
        with target.open("xb") as out:
            shutil.copyfileobj(file, out, CHUNK_BYTES)
