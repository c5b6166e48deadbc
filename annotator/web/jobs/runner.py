"""Runs jobs in two lanes, in each one after the other, and keeps the list of all jobs."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from annotator.files import end_of_file, make_private, private_folder
from annotator.text import is_within
from annotator.types.errors import ConfigError, InUseError, NotFoundError
from annotator.web.errors import INTERNAL
from annotator.web.jobs.records import (
    HEAVY,
    PAUSE,
    RESUME,
    SERVER_STOPPED,
    STOP,
    WORK,
    WORKER_MESSAGE,
    Ended,
    Job,
    JobRequest,
    JobState,
    Measured,
    Order,
    Progress,
    WorkerMessage,
    in_background,
    read_journal,
    require_own_files,
    write_journal,
)

LOG = logging.getLogger("annotator.web")

# Work stops at its next batch; a worker that takes longer than this is assumed to hang.
GRACE_S, KILL_AFTER_S = 15.0, 5.0


class WorkerProcess:
    """A worker process with its order. Killing it is safe: the project's database is transactional."""

    def __init__(self, order: Order, log: Path) -> None:
        self._timers: list[threading.Timer] = []
        make_private(log)
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                # -P: never imports modules from the current folder
                [sys.executable, "-P", "-m", "annotator.web.jobs.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                encoding="utf-8",
                # waiting OpenMP threads must not occupy the server's cores
                env={**os.environ, "OMP_WAIT_POLICY": "PASSIVE"},
                # Ctrl-C at the terminal goes to the server only, which stops its workers
                start_new_session=True,
            )
        self._write(order.model_dump_json() + "\n")

    @property
    def pid(self) -> int:
        return self._process.pid

    def messages(self) -> Iterator[WorkerMessage]:
        """Yields the worker's messages until it has ended."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            try:
                yield WORKER_MESSAGE.validate_json(line)
            except ValidationError:
                LOG.warning("invalid message from a worker: %s", line[:200])
        self._process.wait()
        for timer in self._timers:
            timer.cancel()
        self._process.stdout.close()
        with suppress(BrokenPipeError):
            assert self._process.stdin is not None
            self._process.stdin.close()

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._process.poll()

    def stop(self, grace_s: float | None = None) -> None:
        """Asks the worker to stop; terminates it after `grace_s`, and kills it `KILL_AFTER_S` seconds later."""
        grace_s = GRACE_S if grace_s is None else grace_s
        self._write(STOP)
        self._later(grace_s, signal.SIGTERM)
        self._later(grace_s + KILL_AFTER_S, signal.SIGKILL)

    def pause(self, is_paused: bool) -> None:
        """Asks the worker to wait at its next safe point, or to go on."""
        self._write(PAUSE if is_paused else RESUME)

    def _later(self, seconds: float, number: signal.Signals) -> None:
        timer = threading.Timer(seconds, self._signal, (number,))
        timer.daemon = True
        self._timers.append(timer)
        timer.start()

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError):
            # the worker's session includes its child processes
            if self._process.poll() is None:
                os.killpg(self._process.pid, number)

    def _write(self, text: str) -> None:
        assert self._process.stdin is not None
        # `messages` handles a worker that has ended
        with suppress(BrokenPipeError, ValueError):
            self._process.stdin.write(text)
            self._process.stdin.flush()


# Number of listed jobs, of downloads kept per project, and of jobs that may wait.
JOBS_KEPT, EXPORTS_KEPT, MOST_WAITING = 50, 3, 20
WORK_LOG = "worker.log"
# A job in the background goes on this long after the last request that it made room for.
PAUSE_AFTER_S = 2.0
# Shorter than GRACE_S, so that the server ends quickly.
CLOSING_GRACE_S = 3.0

OnChange = Callable[[Job], None]
"""Called with every changed job, from any thread."""

PublicMessage = Callable[[str], str]
"""Converts a message into one for browsers (see `Context.public_message`)."""


class _Task(NamedTuple):
    job_id: str
    path: Path
    request: JobRequest

    @property
    def is_heavy(self) -> bool:
        return self.request.kind in HEAVY


class JobRunner:
    """Runs jobs in worker processes, at most one of each lane at a time, and keeps their records. Thread-safe.

    Attributes:
        folder: contains the journal, and a sub-folder for each job that runs or has results.
    """

    def __init__(
        self,
        folder: Path,
        on_change: OnChange,
        public_message: PublicMessage,
        readable: tuple[Path, ...] | None = None,
    ) -> None:
        require_own_files(folder)
        self.folder = folder
        self._on_change, self._public_message, self._readable = on_change, public_message, readable
        self._lock = threading.Condition()
        self._jobs: dict[str, Job] = {job.id: job for job in read_journal(folder)}
        self._waiting: list[_Task] = []
        self._current: list[_Task] = []
        self._workers: dict[str, WorkerProcess] = {}
        self._stopping: set[str] = set()
        self._closed = False
        # requests that a job in the background makes room for: how many there are, and how many there were
        self._drawing, self._pauses = 0, 0
        # jobs in the background that stop for another one, and then wait again
        self._aside: set[str] = set()
        self._threads = [threading.Thread(target=self._run, args=(heavy,), daemon=True) for heavy in (True, False)]

    def start(self) -> None:
        """Starts the threads, and removes folders of jobs that are no longer listed."""
        self._tidy()
        for thread in self._threads:
            thread.start()

    def add(self, project: str, path: Path, request: JobRequest, operator: str) -> Job:
        """Adds a job for the project in the folder `path`."""
        job = Job(
            id=uuid.uuid4().hex,
            project=project,
            kind=request.kind,
            created_ns=time.time_ns(),
            operator=operator,
            background=in_background(request),
        )
        task = _Task(job.id, path, request)
        with self._lock:
            if len(self._waiting) >= MOST_WAITING:
                raise ConfigError(f"{MOST_WAITING} jobs are waiting already; stop some, or wait until they are done")
            self._jobs[job.id] = job
            self._waiting.append(task)
            self._publish(job)
            self._lock.notify_all()
            aside = self._background() if task.is_heavy and not job.background else None
            if aside is not None and aside.id not in self._aside:
                self._aside.add(aside.id)
                if aside.id in self._workers:
                    self._workers[aside.id].stop()
        return job

    def is_idle(self) -> bool:
        return all(job.state.ended for job in self.all())

    @contextmanager
    def stepping_aside(self) -> Iterator[None]:
        """Pauses a running job in the background, until `PAUSE_AFTER_S` after the last of these contexts has ended."""
        with self._lock:
            self._drawing += 1
            self._pause(True)
        try:
            yield
        finally:
            with self._lock:
                self._drawing -= 1
                if self._background() is not None:
                    timer = threading.Timer(PAUSE_AFTER_S, self._resume, (self._pauses,))
                    timer.daemon = True
                    timer.start()

    def _resume(self, pauses: int) -> None:
        with self._lock:
            if pauses == self._pauses and self._drawing == 0:
                self._pause(False)

    def _pause(self, is_paused: bool) -> None:
        self._pauses += is_paused
        job = self._background()
        if job is not None and job.id in self._workers:
            self._workers[job.id].pause(is_paused)

    def _background(self) -> Job | None:
        """The running job in the background, if any."""
        return next((job for job in self._jobs.values() if job.background and job.state is JobState.RUNNING), None)

    def all(self) -> list[Job]:
        """All jobs, the newest first."""
        with self._lock:
            return sorted(self._jobs.values(), key=lambda job: job.created_ns, reverse=True)

    def get(self, job_id: str) -> Job:
        with self._lock:
            if job_id not in self._jobs:
                raise NotFoundError(f"there is no job {job_id!r}; it may be too old to be listed")
            return self._jobs[job_id]

    def cancel(self, job_id: str) -> Job:
        """Stops a job: a waiting one at once, a running one at its next safe point."""
        with self._lock:
            job = self.get(job_id)
            waiting = [task for task in self._waiting if task.job_id == job_id]
            self._waiting = [task for task in self._waiting if task.job_id != job_id]
            running = job.state is JobState.RUNNING
            if running and job_id not in self._stopping:
                self._stopping.add(job_id)
                if job_id in self._workers:
                    self._workers[job_id].stop()
            if waiting:
                return self._update(job_id, state=JobState.CANCELLED, message="stopped before it began")
            return self._update(job_id, stage="stopping") if running else job

    def require_none(self, project: str) -> None:
        """Checks that no job of a project runs or waits."""
        for job in self.all():
            if job.project == project and not job.state.ended:
                raise InUseError(
                    f"project {project} has a job that runs or waits ({job.kind}); stop it, or wait until it is done"
                )

    def renamed(self, project: str, name: str) -> None:
        """Lists the jobs of a project under its new name."""
        for job in self.all():
            if job.project == project:
                self._update(job.id, project=name)
        with self._lock:
            write_journal(self.folder, reversed(self.all()))

    def file(self, job_id: str) -> Path:
        job = self.get(job_id)
        path = self._export_file(job)
        if path is None or job.download == "gone" or not path.is_file():
            raise NotFoundError("this job has no file to download, or its file was removed; export again")
        return path

    def _export_file(self, job: Job) -> Path | None:
        name = (job.result or {}).get("file")
        if job.state is not JobState.DONE or name is None:
            return None
        # the journal may have come with projects of somebody else
        file = self.folder / job.id / Path(str(name)).name
        return file if is_within(file.parent, file) else None

    def close(self) -> None:
        """Ends the threads: stops the running jobs, and fails the waiting ones."""
        with self._lock:
            self._closed = True
            waiting, self._waiting = self._waiting, []
            for worker in self._workers.values():
                worker.stop(CLOSING_GRACE_S)
            self._lock.notify_all()
        for task in waiting:
            self._update(task.job_id, state=JobState.FAILED, message=SERVER_STOPPED)
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    # --- in the runner's threads -----------------------------------------------------------------------------

    def _run(self, heavy: bool) -> None:
        while (task := self._next(heavy)) is not None:
            try:
                self._run_job(task)
            except Exception:  # a job that cannot be started must not block the next ones
                LOG.exception("job %s failed", task.job_id)
                self._update(task.job_id, state=JobState.FAILED, message=INTERNAL)
            with self._lock:
                self._current.remove(task)
                self._stopping.discard(task.job_id)
                self._aside.discard(task.job_id)
            self._tidy()

    def _next(self, heavy: bool) -> _Task | None:
        with self._lock:
            while not self._closed:
                lane = [task for task in self._waiting if task.is_heavy == heavy]
                if lane:
                    task = next((task for task in lane if not in_background(task.request)), lane[0])
                    self._waiting.remove(task)
                    self._current.append(task)
                    self._jobs[task.job_id] = self._jobs[task.job_id].model_copy(update={"state": JobState.RUNNING})
                    return task
                self._lock.wait()
        return None

    def _run_job(self, task: _Task) -> None:
        job_id, path, request = task
        began = time.monotonic()
        self._update(job_id, stage="starting")
        folder = self.folder / job_id
        private_folder(folder)
        order = Order(
            target=WORK[request.kind],
            project=path.resolve(),
            folder=folder.resolve(),
            readable=self._readable,
            operator=self.get(job_id).operator,
            request=request,
        )
        worker = WorkerProcess(order, folder / WORK_LOG)
        with self._lock:
            self._workers[job_id] = worker
            if self._closed or job_id in self._stopping | self._aside:
                worker.stop(CLOSING_GRACE_S)
            elif self._drawing:
                self._pause(True)
        last: WorkerMessage | None = None
        for last in worker.messages():
            self._handle(job_id, last, began)
        with self._lock:
            del self._workers[job_id]
        self._ended(task, last, worker.exit_code)

    def _handle(self, job_id: str, message: WorkerMessage, began: float) -> None:
        match message:
            case Progress():
                stage = "stopping" if job_id in self._stopping else message.stage
                left_s = _estimate(message, began)
                self._update(job_id, stage=stage, done=message.done, total=message.total, eta_s=left_s)
            case Measured():
                self._update(job_id, curves=(*self.get(job_id).curves, message.point))

    def _ended(self, task: _Task, last: WorkerMessage | None, exit_code: int | None) -> None:
        job_id = task.job_id
        was_stopped = not isinstance(last, Ended) or last.state is JobState.CANCELLED
        with self._lock:
            if was_stopped and job_id in self._aside - self._stopping and not self._closed:
                self._waiting.append(task)
                self._update(job_id, state=JobState.QUEUED, stage="", done=0.0, total=0.0, eta_s=None, curves=())
                return
        end: dict[str, Any] = {"state": JobState.FAILED}
        match last:
            case Ended(state=JobState.DONE, message=message, result=result):
                download = "kept" if result and "file" in result else None
                end = {"state": JobState.DONE, "message": message, "result": result, "download": download}
                end["done"] = self.get(job_id).total
            case _ if self._closed:
                end["message"] = SERVER_STOPPED
            case Ended(is_fault=True):
                LOG.error("job %s failed:\n%s", job_id, last.message)
                end["message"] = INTERNAL
            case Ended(state=state, message=message):
                end = {"state": state, "message": message}
            case _ if job_id in self._stopping:
                end = {"state": JobState.CANCELLED, "message": "stopped"}
            case _:
                LOG.error("job %s: its worker ended with code %s\n%s", job_id, exit_code, self._log_end(job_id))
                end["message"] = f"the worker ended unexpectedly ({_reason(exit_code)})"
        self._update(job_id, stage="", eta_s=None, **_public(end, self._public_message))

    def _log_end(self, job_id: str) -> str:
        path = self.folder / job_id / WORK_LOG
        return end_of_file(path, 4000) if path.is_file() else ""

    def _update(self, job_id: str, **changes: Any) -> Job:
        # within the lock, so that concurrent changes reach the pages and the journal in the same order
        with self._lock:
            job = self._jobs[job_id] = self._jobs[job_id].model_copy(update=changes)
            self._publish(job, write=not changes.keys().isdisjoint(("state", "download")))
        return job

    def _publish(self, job: Job, write: bool = True) -> None:
        self._on_change(job)
        if write:
            write_journal(self.folder, reversed(self.all()))

    def _tidy(self) -> None:
        """Removes the oldest jobs from the list, marks outdated exports as gone, and deletes their files."""
        # listed first: what another thread begins meanwhile is not looked at
        folders = [path for path in self.folder.iterdir() if path.is_dir()] if self.folder.is_dir() else []
        with self._lock:
            exports = self._latest_exports()
            old = [job.id for job in self.all() if job.state.ended and job.id not in exports][JOBS_KEPT:]
            for job_id in old:
                del self._jobs[job_id]
            needed = exports | {job.id for job in self._jobs.values() if not job.state.ended}
            # marked before the removal, so that no page offers a file that is being removed; within the lock, as the
            # other lane may take a job off the list
            for job in self.all():
                file = self._export_file(job)
                download = None if file is None else "kept" if job.id in needed and file.is_file() else "gone"
                if download != job.download:
                    self._update(job.id, download=download)
        for path in folders:
            if path.name not in needed:
                shutil.rmtree(path, ignore_errors=True)

    def _latest_exports(self) -> set[str]:
        """Ids of the latest exports of each project."""
        by_project: dict[str, list[str]] = defaultdict(list)
        for job in self.all():
            if self._export_file(job) is not None:
                by_project[job.project].append(job.id)
        return {job_id for exports in by_project.values() for job_id in exports[:EXPORTS_KEPT]}


def _estimate(message: Progress, began: float) -> float | None:
    """Remaining seconds at the average speed so far."""
    if not 0 < message.done <= message.total:
        return None
    return (time.monotonic() - began) * (message.total - message.done) / message.done


def _public(value: Any, public_message: PublicMessage) -> Any:
    """The same JSON with every text converted for browsers."""
    match value:
        case JobState():
            return value
        case str():
            return public_message(value)
        case dict():
            return {name: _public(entry, public_message) for name, entry in value.items()}
        case list():
            return [_public(entry, public_message) for entry in value]
        case _:
            return value


def _reason(exit_code: int | None) -> str:
    if exit_code == -9:
        return "killed, possibly out of memory"
    return f"exit code {exit_code}; see the server's log"
