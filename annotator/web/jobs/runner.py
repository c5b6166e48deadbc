"""Runs jobs one after the other, and knows all of them."""

from __future__ import annotations

import logging
import shutil
import threading
import time
import uuid
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from annotator.types.errors import ConfigError, NotFoundError
from annotator.web.errors import INTERNAL
from annotator.web.jobs.journal import SERVER_STOPPED, read_journal, write_journal
from annotator.web.jobs.messages import Failed, Finished, Measured, Order, Progress, Said, Stopped
from annotator.web.jobs.process import GRACE_S, WorkerProcess
from annotator.web.jobs.records import Job, JobRequest, JobState
from annotator.web.jobs.table import WORK

LOG = logging.getLogger("annotator.web")

# Exports are kept for each project.
JOBS_KEPT, EXPORTS_KEPT, MOST_WAITING = 50, 3, 20
WORK_LOG = "worker.log"
# Somebody waits for the server to end.
CLOSING_GRACE_S = 3.0

Tell = Callable[[Job], None]
"""Told of every change of a job, from any thread."""

Words = Callable[[str], str]
"""Makes of a message what pages may read."""


class JobRunner:
    """Takes jobs, runs one at a time in a worker process, and keeps what is known of them. Threads share it.

    Attributes:
        folder: of the journal, and of one folder a job while there is something in it.
    """

    def __init__(self, folder: Path, tell: Tell, words: Words, grace_s: float = GRACE_S) -> None:
        self.folder = folder
        self._tell, self._words, self._grace_s = tell, words, grace_s
        self._lock = threading.Condition()
        self._jobs: dict[str, Job] = {job.id: job for job in read_journal(folder)}
        self._waiting: list[tuple[str, Path, JobRequest]] = []
        self._worker: WorkerProcess | None = None
        self._asked_to_stop: str | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="jobs", daemon=True)

    def start(self) -> None:
        """Begins; folders that no known job needs are removed."""
        self._tidy()
        self._thread.start()

    def add(self, project: str, path: Path, request: JobRequest, operator: str) -> Job:
        """Takes a job for the project in the folder `path`.

        Raises:
            ConfigError: too many wait already.
        """
        job = Job(id=uuid.uuid4().hex, project=project, kind=request.kind, created_ns=time.time_ns(), operator=operator)
        with self._lock:
            if len(self._waiting) >= MOST_WAITING:
                raise ConfigError(f"{MOST_WAITING} jobs wait already; stop some, or wait until they are done")
            self._jobs[job.id] = job
            self._waiting.append((job.id, path, request))
            self._changed(job)
            self._lock.notify_all()
        return job

    def all(self) -> list[Job]:
        """Every job, the newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: job.created_ns, reverse=True)

    def get(self, job_id: str) -> Job:
        """One job.

        Raises:
            NotFoundError: no such job.
        """
        with self._lock:
            if job_id not in self._jobs:
                raise NotFoundError(f"there is no job {job_id!r} (any more)")
            return self._jobs[job_id]

    def cancel(self, job_id: str) -> Job:
        """Stops a job: one that waits at once, one that runs as soon as it comes to a good end.

        Raises:
            NotFoundError: no such job.
        """
        job = self.get(job_id)
        with self._lock:
            waiting = [entry for entry in self._waiting if entry[0] == job_id]
            for entry in waiting:
                self._waiting.remove(entry)
            running = self._jobs[job_id].state is JobState.RUNNING
            if running and self._asked_to_stop != job_id:
                self._asked_to_stop = job_id
                if self._worker is not None:
                    self._worker.stop(self._grace_s)
        if waiting:
            return self._update(job_id, state=JobState.CANCELLED, message="stopped before it began")
        return self._update(job_id, stage="stopping") if running else job

    def file(self, job_id: str) -> Path:
        """The file that an export has left.

        Raises:
            NotFoundError: no such job, or it has left none (any more).
        """
        job = self.get(job_id)
        path = self._made(job)
        if path is None or job.download == "gone" or not path.is_file():
            raise NotFoundError("there is nothing to download (any more); export again")
        return path

    def _made(self, job: Job) -> Path | None:
        name = (job.result or {}).get("file")
        return None if job.state is not JobState.DONE or name is None else self.folder / job.id / str(name)

    def close(self) -> None:
        """Ends: what runs is stopped, and what waits is not begun."""
        with self._lock:
            self._closed = True
            waiting, self._waiting = self._waiting, []
            if self._worker is not None:
                self._worker.stop(min(self._grace_s, CLOSING_GRACE_S))
            self._lock.notify_all()
        for job_id, _, _ in waiting:
            self._update(job_id, state=JobState.FAILED, message=SERVER_STOPPED)
        if self._thread.is_alive():
            self._thread.join()

    # --- in the runner's own thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        while (entry := self._next()) is not None:
            job_id, path, request = entry
            try:
                self._do(job_id, path, request)
            except Exception:  # a job that cannot even be begun must not keep the next ones waiting
                LOG.exception("job %s failed", job_id)
                self._update(job_id, state=JobState.FAILED, message=INTERNAL)
            self._tidy()

    def _next(self) -> tuple[str, Path, JobRequest] | None:
        with self._lock:
            while not self._waiting and not self._closed:
                self._lock.wait()
            if self._closed:
                return None
            entry = self._waiting.pop(0)
            self._jobs[entry[0]] = self._jobs[entry[0]].model_copy(update={"state": JobState.RUNNING})
            self._asked_to_stop = None
            return entry

    def _do(self, job_id: str, path: Path, request: JobRequest) -> None:
        began = time.monotonic()
        self._update(job_id, stage="starting")
        folder = self.folder / job_id
        folder.mkdir(parents=True, exist_ok=True)
        order = Order(target=WORK[request.kind], project=path.resolve(), folder=folder.resolve(), request=request)
        worker = WorkerProcess(order, folder / WORK_LOG)
        with self._lock:
            self._worker = worker
            if self._closed or self._asked_to_stop == job_id:
                worker.stop(CLOSING_GRACE_S)
        last: Said | None = None
        for message in worker.said():
            self._heard(job_id, message, began)
            last = message
        with self._lock:
            self._worker = None
        self._ended(job_id, last, worker.exit_code)

    def _heard(self, job_id: str, message: Said, began: float) -> None:
        job = self.get(job_id)
        match message:
            case Progress():
                stage = "stopping" if self._asked_to_stop == job_id else message.stage
                eta_s = message.eta_s if message.eta_s is not None else _estimate(message, began)
                self._update(job_id, stage=stage, done=message.done, total=message.total, eta_s=eta_s)
            case Measured():
                self._update(job_id, curves=(*job.curves, message.point))

    def _ended(self, job_id: str, last: Said | None, exit_code: int | None) -> None:
        match last:
            case Finished():
                done = self.get(job_id).total
                end = {"state": JobState.DONE, "message": last.message, "result": last.result, "done": done}
                end["download"] = "kept" if "file" in last.result else None
            case _ if self._closed:
                end = {"state": JobState.FAILED, "message": SERVER_STOPPED}
            case Failed(is_fault=True):
                LOG.error("job %s failed:\n%s", job_id, last.message)
                end = {"state": JobState.FAILED, "message": INTERNAL}
            case Failed():
                end = {"state": JobState.FAILED, "message": last.message}
            case Stopped():
                end = {"state": JobState.CANCELLED, "message": last.message}
            case _ if self._asked_to_stop == job_id:
                end = {"state": JobState.CANCELLED, "message": "stopped"}
            case _:
                LOG.error("job %s: its worker ended with code %s\n%s", job_id, exit_code, self._log_end(job_id))
                end = {"state": JobState.FAILED, "message": f"the worker ended unexpectedly ({_reason(exit_code)})"}
        self._update(job_id, stage="", eta_s=None, **_reworded(end, self._words))

    def _log_end(self, job_id: str) -> str:
        path = self.folder / job_id / WORK_LOG
        return path.read_text(encoding="utf-8", errors="replace")[-4000:] if path.is_file() else ""

    def _update(self, job_id: str, **changes: Any) -> Job:
        # within the lock, so that what two threads say reaches the pages and the journal in its order
        with self._lock:
            job = self._jobs[job_id] = self._jobs[job_id].model_copy(update=changes)
            self._changed(job, keep=not changes.keys().isdisjoint(("state", "download")))
        return job

    def _changed(self, job: Job, keep: bool = True) -> None:
        self._tell(job)
        if keep:
            write_journal(self.folder, reversed(self.all()))

    def _tidy(self) -> None:
        """Forgets the oldest jobs, says of others that what they made is gone, and removes that."""
        with self._lock:
            exports = self._latest_exports()
            old = [job.id for job in self.all() if job.state.ended and job.id not in exports][JOBS_KEPT:]
            for job_id in old:
                del self._jobs[job_id]
            wanted = exports | {job.id for job in self._jobs.values() if not job.state.ended}
        # said before it is removed, so that nobody is offered what is being removed
        for job in self.all():
            made = self._made(job)
            download = None if made is None else "kept" if job.id in wanted and made.is_file() else "gone"
            if download != job.download:
                self._update(job.id, download=download)
        if self.folder.is_dir():
            for path in self.folder.iterdir():
                if path.is_dir() and path.name not in wanted:
                    shutil.rmtree(path, ignore_errors=True)

    def _latest_exports(self) -> set[str]:
        """The last few of each project."""
        by_project: dict[str, list[str]] = defaultdict(list)
        for job in self.all():
            if self._made(job) is not None:
                by_project[job.project].append(job.id)
        return {job_id for exports in by_project.values() for job_id in exports[:EXPORTS_KEPT]}


def _estimate(message: Progress, began: float) -> float | None:
    """Seconds left at the pace so far."""
    if not 0 < message.done <= message.total:
        return None
    return (time.monotonic() - began) * (message.total - message.done) / message.done


def _reworded(value: Any, words: Words) -> Any:
    """The same JSON with every text in it made readable for pages."""
    match value:
        case JobState():
            return value
        case str():
            return words(value)
        case dict():
            return {name: _reworded(entry, words) for name, entry in value.items()}
        case list():
            return [_reworded(entry, words) for entry in value]
        case _:
            return value


def _reason(exit_code: int | None) -> str:
    if exit_code == -9:
        return "it was killed, perhaps for want of memory"
    return f"exit code {exit_code}; see the server's log"
