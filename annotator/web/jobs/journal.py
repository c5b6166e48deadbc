"""The journal: the list of jobs on disk, read when a server starts."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from annotator.files import private_folder, write_atomic
from annotator.web.jobs.records import Job, JobState

LOG = logging.getLogger("annotator.web")

FILE = "journal.json"
SERVER_STOPPED = "the server was stopped"


class _Journal(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    jobs: tuple[Job, ...]


def read_journal(folder: Path) -> list[Job]:
    """The jobs in the journal, oldest first; unfinished ones become failed. Empty if it is missing or unreadable."""
    path = folder / FILE
    try:
        jobs = _Journal.model_validate_json(path.read_bytes()).jobs
    except FileNotFoundError:
        return []
    except (OSError, ValidationError) as error:
        # the server can start without the list of earlier jobs
        LOG.warning("%s: cannot be read, earlier jobs are not listed: %s", path, error)
        return []
    return [_ended(job) for job in jobs]


def write_journal(folder: Path, jobs: Iterable[Job]) -> None:
    """Writes the journal; an error is logged only."""
    try:
        private_folder(folder)
        write_atomic(folder / FILE, _Journal(jobs=tuple(jobs)).model_dump_json().encode(), private=True)
    except OSError as error:
        LOG.warning("%s: the list of jobs cannot be written: %s", folder, error)


def _ended(job: Job) -> Job:
    if job.state.ended:
        return job
    return job.model_copy(update={"state": JobState.FAILED, "message": SERVER_STOPPED, "eta_s": None})
