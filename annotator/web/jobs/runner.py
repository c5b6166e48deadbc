"""Runs jobs in two lanes, in each one after the other, and keeps the list of all jobs."""

from __future__ import annotations

import logging
import os
import shutil
import signal
import subprocess
import threading
import time
import traceback
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from annotator.child import Child
from annotator.files import end_of_file, make_private, private_folder
from annotator.text import is_within
from annotator.types.errors import ConfigError, InUseError, NotFoundError
from annotator.web.errors import INTERNAL
from annotator.web.jobs.records import (
    HEAVY,
    PAUSE,
    SERVER_STOPPED,
    STOP,
    WORK,
    Ended,
    Job,
    JobRequest,
    JobState,
    Measured,
    Order,
    Progress,
    WorkerMessage,
    expected_s,
    in_background,
    read_journal,
    require_own_files,
    write_journal,
)

LOG = logging.getLogger("annotator.web")

# Work stops at its next batch; a worker that takes longer than this is assumed to hang.
GRACE_S, KILL_AFTER_S = 15.0, 5.0
WORKER = "annotator.web.jobs.worker:main"


class WorkerProcess:
    """A worker process with its order. Killing it is safe: the project's database is transactional."""

    def __init__(self, order: Order, log: Path) -> None:
        make_private(log)
        # waiting OpenMP threads must not occupy the server's cores; Ctrl-C goes to the server, which stops its workers
        with log.open("wb") as errors:
            self._child = Child(WORKER, {"OMP_WAIT_POLICY": "PASSIVE"}, errors, in_session=True)
        self._child.send(order)

    def messages(self) -> Iterator[WorkerMessage]:
        """Yields the worker's messages until it has ended."""
        with suppress(EOFError):
            while True:
                yield self._child.receive()
        self._child.process.wait()
        self._child.close()

    @property
    def exit_code(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        return self._child.process.poll()

    def stop(self, grace_s: float | None = None) -> None:
        """Asks the worker to stop; terminates it after `grace_s`, and kills it `KILL_AFTER_S` seconds later."""
        self._child.send(STOP)
        waits_s = (GRACE_S if grace_s is None else grace_s), KILL_AFTER_S
        threading.Thread(target=self._end, args=waits_s, daemon=True).start()

    def pause(self) -> None:
        """Asks the worker to wait for a moment at its next safe point."""
        self._child.send(PAUSE)

    def _end(self, *waits_s: float) -> None:
        for wait_s, number in zip(waits_s, (signal.SIGTERM, signal.SIGKILL), strict=True):
            try:
                self._child.process.wait(wait_s)
                return
            except subprocess.TimeoutExpired:
                with suppress(ProcessLookupError):
                    # the worker's session includes its child processes
                    os.killpg(self._child.process.pid, number)


# Number of listed jobs, of downloads kept per project, and of jobs that may wait.
JOBS_KEPT, EXPORTS_KEPT, MOST_WAITING = 50, 3, 20
WORK_LOG = "worker.log"
# A job in the background is told so often, at most, that somebody works on a frame.
PAUSE_EVERY_S = 0.5
# Shorter than GRACE_S, so that the server ends quickly.
CLOSING_GRACE_S = 3.0

OnChange = Callable[[Job], None]
"""Called with every changed job, from any thread."""

PublicMessage = Callable[[str], str]
"""Converts a message into one for browsers (see `Context.public_message`)."""


@dataclass(eq=False)
class _Task:
    """A job that waits or runs.

    Attributes:
        end: why the running job was asked to stop; "aside": for another job, after which it begins again.
    """

    job_id: str
    order: Order
    worker: WorkerProcess | None = None
    end: Literal["stopped", "aside"] | None = None

    @property
    def is_heavy(self) -> bool:
        return self.order.request.kind in HEAVY

    @property
    def in_background(self) -> bool:
        return in_background(self.order.request)


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
        self._tasks: list[_Task] = []
        self._closed = False
        self._paused_s = 0.0
        self._threads = [threading.Thread(target=self._run, args=(heavy,), daemon=True) for heavy in (True, False)]

    def start(self) -> None:
        """Starts the threads, and removes folders of jobs that are no longer listed."""
        self._tidy()
        for thread in self._threads:
            thread.start()

    def add(self, project: str, path: Path, request: JobRequest, operator: str) -> Job:
        """Adds a job for the project in the folder `path`."""
        order = Order(
            target=WORK[request.kind],
            project=path.resolve(),
            folder=self.folder.resolve() / uuid.uuid4().hex,
            readable=self._readable,
            operator=operator,
            request=request,
        )
        job = Job(
            id=order.folder.name,
            project=project,
            kind=request.kind,
            created_ns=time.time_ns(),
            operator=operator,
            heavy=request.kind in HEAVY,
            background=in_background(request),
        )
        task = _Task(job.id, order)
        with self._lock:
            if sum(self._waits(each) for each in self._tasks) >= MOST_WAITING:
                raise ConfigError(f"{MOST_WAITING} jobs are waiting already; stop some, or wait until they are done")
            self._jobs[job.id] = job
            self._tasks.append(task)
            self._publish(job)
            self._lock.notify_all()
            for other in self._background() if task.is_heavy and not job.background else []:
                self._stop(other, "aside")
        return job

    def is_idle(self) -> bool:
        return all(job.state.ended for job in self.all())

    def step_aside(self) -> None:
        """Lets a job in the background wait for a moment, since somebody works on a frame."""
        now_s = time.monotonic()
        if now_s - self._paused_s < PAUSE_EVERY_S:
            return
        with self._lock:
            self._paused_s = now_s
            for task in self._background():
                if task.worker is not None:
                    task.worker.pause()

    def _background(self) -> list[_Task]:
        """The running jobs in the background."""
        return [task for task in self._tasks if task.in_background and not self._waits(task)]

    def _waits(self, task: _Task) -> bool:
        return self._jobs[task.job_id].state is JobState.QUEUED

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
            task = next((task for task in self._tasks if task.job_id == job_id), None)
            if task is None or job.state.ended:
                return job
            if self._waits(task):
                self._tasks.remove(task)
                return self._update(job_id, state=JobState.CANCELLED, message="stopped before it began")
            self._stop(task, "stopped")
            return self._update(job_id, stage="stopping")

    def _stop(self, task: _Task, why: Literal["stopped", "aside"]) -> None:
        """Asks a running job to stop, once."""
        if task.end is None and task.worker is not None:
            task.worker.stop()
        if task.end != "stopped":
            task.end = why

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
            for task in self._tasks:
                if self._waits(task):
                    self._update(task.job_id, state=JobState.FAILED, message=SERVER_STOPPED)
                elif task.worker is not None:
                    task.worker.stop(CLOSING_GRACE_S)
            self._lock.notify_all()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    # --- in the runner's threads -----------------------------------------------------------------------------

    def _run(self, heavy: bool) -> None:
        while (task := self._next(heavy)) is not None:
            try:
                last, exit_code = self._run_job(task)
            except Exception:  # a job that cannot be started must not block the next ones
                fault = Ended(state=JobState.FAILED, message=traceback.format_exc(), is_fault=True)
                last, exit_code = fault, None
            # at once: a job that waits again may be stopped by then
            with self._lock:
                self._update(task.job_id, stage="", eta_s=None, **self._ended(task, last, exit_code))
                task.worker = task.end = None
                if not self._waits(task):
                    self._tasks.remove(task)
            self._tidy()

    def _next(self, heavy: bool) -> _Task | None:
        with self._lock:
            while not self._closed:
                lane = [task for task in self._tasks if task.is_heavy == heavy and self._waits(task)]
                if lane:
                    # those in the background last
                    task = min(lane, key=lambda each: each.in_background)
                    self._jobs[task.job_id] = self._jobs[task.job_id].model_copy(update={"state": JobState.RUNNING})
                    return task
                self._lock.wait()
        return None

    def _run_job(self, task: _Task) -> tuple[WorkerMessage | None, int | None]:
        """Returns the last message of the worker, and its exit code."""
        job_id, began_s = task.job_id, time.monotonic()
        expected = expected_s(task.order.request)
        self._update(job_id, stage="starting", eta_s=expected)
        private_folder(task.order.folder)
        worker = WorkerProcess(task.order, task.order.folder / WORK_LOG)
        with self._lock:
            task.worker = worker
            if self._closed or task.end:
                worker.stop(CLOSING_GRACE_S)
        last: WorkerMessage | None = None
        for last in worker.messages():
            match last:
                case Progress():
                    stage = "stopping" if task.end == "stopped" else last.stage
                    spent_s, left = time.monotonic() - began_s, last.total - last.done
                    eta_s = None if expected is None else max(expected - spent_s, 0.0)
                    if 0 < last.done <= last.total:  # at the average speed so far
                        eta_s = spent_s * left / last.done
                    self._update(job_id, stage=stage, done=last.done, total=last.total, eta_s=eta_s)
                case Measured():
                    self._update(job_id, curves=(*self.get(job_id).curves, last.point))
        return last, worker.exit_code

    def _ended(self, task: _Task, last: WorkerMessage | None, exit_code: int | None) -> dict[str, Any]:
        """What the record of a job gets at its end, with the last message of its worker."""
        failed, job_id = {"state": JobState.FAILED}, task.job_id
        is_complete = isinstance(last, Ended) and last.state is not JobState.CANCELLED
        if task.end == "aside" and not is_complete and not self._closed:
            return {"state": JobState.QUEUED, "done": 0.0, "total": 0.0, "curves": ()}
        match last:
            case Ended(state=JobState.DONE, message=message, result=result):
                download = "kept" if result and "file" in result else None
                facts = _public({"message": message, "result": result}, self._public_message)
                return {"state": JobState.DONE, "download": download, "done": self.get(job_id).total, **facts}
            case _ if self._closed:
                return {**failed, "message": SERVER_STOPPED}
            case Ended(is_fault=True):
                LOG.error("job %s failed:\n%s", job_id, last.message)
                return {**failed, "message": INTERNAL}
            case Ended(state=state, message=message):
                return {"state": state, "message": self._public_message(message)}
            case _ if task.end:
                return {"state": JobState.CANCELLED, "message": "stopped"}
        log = task.order.folder / WORK_LOG
        said = end_of_file(log, 4000) if log.is_file() else ""
        LOG.error("job %s: its worker ended with code %s\n%s", job_id, exit_code, said)
        why = "killed, possibly out of memory" if exit_code == -9 else f"exit code {exit_code}; see the server's log"
        return {**failed, "message": f"the worker ended unexpectedly ({why})"}

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
            by_project: dict[str, list[str]] = defaultdict(list)
            for job in self.all():
                if self._export_file(job) is not None:
                    by_project[job.project].append(job.id)
            exports = {job_id for latest in by_project.values() for job_id in latest[:EXPORTS_KEPT]}
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


def _public(value: Any, public_message: PublicMessage) -> Any:
    """The same JSON with every text converted for browsers."""
    match value:
        case str():
            return public_message(value)
        case dict():
            return {name: _public(entry, public_message) for name, entry in value.items()}
        case list() | tuple():
            return [_public(entry, public_message) for entry in value]
        case _:
            return value
