"""Changes `project.json` together with the database: both have the old classes or both the new ones, also after a kill.

The new file is written beside the old one before the transaction ends, under a name with the number of its event.
Afterwards it takes the old one's place. After a kill, the next process looks for that event: if the log has it, the
transaction has ended well, and the new file counts; otherwise it is removed.
"""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Connection, func, select

from annotator.files import read_file, sync_folder, write_atomic
from annotator.project.config import CONFIG_FILE, ProjectConfig, config_bytes, read_config
from annotator.project.database.schema import events
from annotator.project.log.event_types import ClassesChanged
from annotator.project.log.events import event_of
from annotator.project.log.records import parsed
from annotator.types.errors import ProjectError

_PREPARED = f"{CONFIG_FILE}.event-"


def prepare_config(folder: Path, config: ProjectConfig, connection: Connection) -> Path:
    """Writes the configuration that counts once the transaction of `connection` has ended; returns its file.

    Raises:
        ProjectError: it cannot be written.
    """
    newest = connection.execute(select(func.max(events.c.id))).scalar()
    path = folder / f"{_PREPARED}{newest}"
    try:
        write_atomic(path, config_bytes(config))
    except OSError as error:
        raise ProjectError(f"{path}: cannot be written: {error}") from error
    return path


def take_config(folder: Path, connection: Connection) -> ProjectConfig:
    """The project's configuration, after a prepared one has taken its place, or was dropped.

    Raises:
        ProjectError: as `read_config`, or the prepared one cannot take its place.
    """
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
    """Whether the log has the event, and not another one with its number, of a transaction that came later."""
    number = path.name.removeprefix(_PREPARED)
    if not number.isdecimal():
        return False
    row = connection.execute(select(events).where(events.c.id == int(number))).first()
    if row is None or row.kind != "classes_changed":
        return False
    payload, config = event_of(row).payload, parsed(ProjectConfig.model_validate_json, read_file(path).decode())
    return isinstance(payload, ClassesChanged) and (payload.names, payload.attributes) == (
        config.classes,
        config.attributes,
    )
