"""Making a new project of a backup, of another one, or of the folder that somebody else has sent."""

from __future__ import annotations

import shutil
from pathlib import Path

from annotator.project.backup.archive import (
    BackupManifest,
    ModelChoice,
    Progress,
    is_regular,
    keep_models,
    open_backup,
    unpack,
)
from annotator.project.backup.repair import remove_labels
from annotator.project.backup.snapshot import (
    copied_files,
    copy_files,
    copy_regular,
    database_problems,
    new_project,
    sync_files,
    write_snapshot,
)
from annotator.project.backup.verify import verify
from annotator.project.config import CONFIG_FILE, check_name, read_config
from annotator.project.database.store import DATABASE_FILE, wal_of
from annotator.types.errors import FormatError, ProjectError
from annotator.types.messages import amount


def restore(
    file: Path, root: Path, name: str | None = None, progress: Progress = lambda done, total: None
) -> tuple[Path, BackupManifest]:
    """Makes the project `root/name` of a backup; the folder appears complete and checked, or not at all."""
    with open_backup(file) as (archive, manifest):
        name = check_name(manifest.project if name is None else name)
        with new_project(root, name) as place:
            unpack(file, archive, place, progress)
            if problems := database_problems(place / DATABASE_FILE):
                raise FormatError(file, f"{DATABASE_FILE}: {problems[0]}")
            sync_files(place)
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
        if not labels:
            remove_labels(database)
        keep_models(database, models)
        names, _ = copied_files(folder, database)
        copy_files(folder, place, names, progress)
        if found := verify(place, deep=True).problems:
            more = f" (and {amount(len(found) - 1, 'more problem')})" if len(found) > 1 else ""
            raise ProjectError(f"{folder}: {found[0]}{more}; nothing was copied")
        sync_files(place)
    return root / name


def _take_database(folder: Path, place: Path) -> None:
    """Copies a foreign database before SQLite sees it: opening one can write to its folder."""
    copied = place / "copied"
    copied.mkdir()
    for part in (DATABASE_FILE, wal_of(Path(DATABASE_FILE)).name):
        if is_regular(folder, part):
            copy_regular(folder / part, copied / part)
    write_snapshot(copied / DATABASE_FILE, place / DATABASE_FILE)
    shutil.rmtree(copied)
