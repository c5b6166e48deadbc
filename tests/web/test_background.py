"""What a server does beside requests: rounds of learning and what they step aside for, and automatic backups."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import fake_jobs
import pytest
from live_server import PATIENCE_S, ended, look
from store_samples import replace_folder
from test_web_jobs import (
    JOBS,
    begin,
    fake,  # noqa: F401  (`fake` is a fixture)
    until,
)

from annotator.project import Project, WriteContext, create_project
from annotator.project.backup.make import Reason, automatic_backups, back_up_automatically
from annotator.project.backup.take_in import restore
from annotator.project.config import BACKUPS
from annotator.project.labels import Labels
from annotator.project.log import ChangedFrame, Log
from annotator.project.models import Models
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.web import background
from annotator.web.background import BACKUPS_PAUSE_S, AutomaticBackups, Learner, Watch
from annotator.web.context import Context
from annotator.web.folders import clear_leftovers
from annotator.web.jobs import runner
from annotator.web.jobs.records import PAUSE, RESUME, STOP, WORK, JobState, TrainRequest
from annotator.web.jobs.runner import STEPPED_ASIDE, JobRunner
from annotator.web.jobs.worker import Orders
from annotator.web.security import ServerSettings
from annotator.workflows.training.held_out import Decision

if TYPE_CHECKING:
    from live_server import Live


MODELS = "/api/projects/room/models"
ROUND = {"kind": "train", "roles": ["view"], "background": True}


@pytest.fixture
def project(tmp_path: Path) -> Iterator[Project]:
    with create_project(tmp_path, "room", ["person"]) as made:
        yield made


@pytest.fixture
def jobs(tmp_path: Path) -> JobRunner:
    """A runner that is not started, so that jobs wait."""
    return JobRunner(tmp_path / "jobs", lambda job: None, str)


@pytest.fixture
def server(live: Live, fake: None, in_threads: None, monkeypatch: pytest.MonkeyPatch) -> Live:  # noqa: F811
    monkeypatch.setitem(WORK, "train", "fake_jobs:train")
    return live


def end_all(jobs: JobRunner, state: JobState = JobState.DONE) -> None:
    for job in jobs.all():
        jobs._update(job.id, state=state)
    jobs._waiting.clear()


def test_a_round_starts_after_every_so_many_reviewed_boxes(
    project: Project, jobs: JobRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    reviewed = [0]
    monkeypatch.setattr(Labels, "count", lambda self, states: reviewed[0])
    learner, started = Learner(jobs), []
    for reviewed[0] in range(40):
        learner.look("room", project)
        if reviewed[0] == 12:
            project.configure(settings=project.config.settings.model_copy(update={"learn_every": 10}))
        if not jobs.is_idle():
            started.append(reviewed[0])
            end_all(jobs)
    # those reviewed before count for the first round
    assert started == [13, 23, 33]
    (job, *_) = jobs.all()
    assert (job.kind, job.project, job.background) == ("train", "room", True)


def test_boxes_from_before_the_newest_detector_are_learned_already(
    project: Project, jobs: JobRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    reviewed = [15]
    monkeypatch.setattr(Labels, "count", lambda self, states: reviewed[0])
    decisions: list[Decision | None] = [None]
    monkeypatch.setattr(Models, "all", lambda self, role: ("a detector",) if role is DetectorKind.VIEW else ())
    monkeypatch.setattr(background, "decision_of", lambda model: decisions[0])
    project.configure(settings=project.config.settings.model_copy(update={"learn_every": 10}))
    learner = Learner(jobs)
    for reviewed[0], waits in ((15, False), (24, False), (25, True)):
        learner.look("room", project)
        assert jobs.is_idle() is not waits
    # after a restart, the record of the newest detector tells which ones are new
    for learned, waits in ((16, False), (15, True)):
        end_all(jobs)
        decisions[0] = Decision(
            objects=0, frames=0, mean_iou=None, compared=(), started_from="", outcome="", reviewed=learned
        )
        Learner(jobs).look("room", project)
        assert jobs.is_idle() is not waits


def test_a_training_that_somebody_started_has_learned_too(
    project: Project, jobs: JobRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    reviewed = [5]
    monkeypatch.setattr(Labels, "count", lambda self, states: reviewed[0])
    project.configure(settings=project.config.settings.model_copy(update={"learn_every": 10}))
    learner = Learner(jobs)
    learner.look("room", project)
    jobs.add("room", project.path, TrainRequest(kind="train"), "Ada")
    reviewed[0] = 20
    learner.look("room", project)
    assert len(jobs.all()) == 1
    end_all(jobs)
    trained = Decision(objects=0, frames=0, mean_iou=None, compared=(), started_from="", outcome="", reviewed=20)
    monkeypatch.setattr(Models, "all", lambda self, role: ("a detector",) if role is DetectorKind.VIEW else ())
    monkeypatch.setattr(background, "decision_of", lambda model: trained)
    for reviewed[0], rounds in ((20, 0), (29, 0), (30, 1)):
        learner.look("room", project)
        assert sum(job.background for job in jobs.all()) == rounds


def test_a_round_that_stepped_aside_starts_again_when_no_other_job_runs(
    project: Project, jobs: JobRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Labels, "count", lambda self, states: 10)
    project.configure(settings=project.config.settings.model_copy(update={"learn_every": 10}))
    learner = Learner(jobs)
    learner.look("room", project)
    (first,) = jobs.all()
    jobs._update(first.id, state=JobState.RUNNING)
    jobs._waiting.clear()
    other = jobs.add("room", project.path, TrainRequest(kind="train"), "Ada")
    assert not jobs.stepped_aside(first.id)
    jobs._update(first.id, state=JobState.DONE)
    assert not jobs.stepped_aside(first.id)
    jobs._update(first.id, state=JobState.CANCELLED)
    assert jobs.stepped_aside(first.id)
    learner.look("room", project)
    assert len(jobs.all()) == 2
    jobs._update(other.id, state=JobState.DONE)
    jobs._waiting.clear()
    for _ in range(3):
        learner.look("room", project)
    assert len(jobs.all()) == 3


def test_a_paused_job_waits_and_a_stop_ends_the_pause() -> None:
    orders = Orders()
    answers: list[bool] = []
    for ending, answer in ((RESUME, False), (STOP, True)):
        orders.take(PAUSE)
        asking = threading.Thread(target=lambda: answers.append(orders.stopped()))
        asking.start()
        asking.join(0.2)
        assert asking.is_alive()
        orders.take(ending)
        asking.join(PATIENCE_S)
        assert answers.pop() is answer


def test_a_job_in_the_background_stops_for_another_job(server: Live) -> None:
    job: dict[str, Any] = server.client.post(JOBS, json=ROUND).json()
    assert job["background"] is True
    until(server, job, "running", "learn")
    other = begin(server, fake_jobs.QUICK)
    assert ended(server, other)["state"] == "done"
    now = ended(server, job)
    assert (now["state"], now["message"]) == ("cancelled", STEPPED_ASIDE)


def test_a_job_in_the_background_waits_while_a_frame_is_worked_on(
    server: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses: list[bool] = []
    pause = runner.WorkerProcess.pause
    monkeypatch.setattr(
        runner.WorkerProcess, "pause", lambda self, paused: (pauses.append(paused), pause(self, paused))
    )
    monkeypatch.setattr(runner, "PAUSE_AFTER_S", 0.2)
    job = server.client.post(JOBS, json=ROUND).json()
    until(server, job, "running", "learn")
    assert server.client.get("/api/projects/room/frames/1").status_code in (200, 404)
    end = time.monotonic() + PATIENCE_S
    while pauses[-2:] != [True, False]:
        assert time.monotonic() < end
        time.sleep(0.05)
    before = look(server, job["id"])["done"]
    while look(server, job["id"])["done"] == before:
        assert time.monotonic() < end
        time.sleep(0.05)
    # a job that is paused can be stopped
    monkeypatch.setattr(runner, "PAUSE_AFTER_S", 600.0)
    server.client.get("/api/projects/room/frames/1")
    server.client.post(f"/api/jobs/{job['id']}/cancel")
    assert ended(server, job)["state"] == "cancelled"


def test_the_switch_is_stored_in_the_project(live: Live) -> None:
    assert live.client.get(MODELS).json()["learn_every"] is None
    assert live.client.put(f"{MODELS}/learning", json={"every": 12}).status_code == 204
    assert live.client.get(MODELS).json()["learn_every"] == 12
    for wrong in ({"every": 0}, {"every": "x"}, {}, {"every": 3, "more": 1}):
        assert live.client.put(f"{MODELS}/learning", json=wrong).status_code == 422
    assert live.client.put(f"{MODELS}/learning", json={"every": None}).status_code == 204
    assert live.client.get(MODELS).json()["learn_every"] is None


OLD = 1_000_000_000


@pytest.fixture
def changed(tmp_path: Path) -> Path:
    """A project whose first change was long ago."""
    with create_project(tmp_path, "room", ("person",), clock=lambda: OLD) as project:
        project.recordings.add(tmp_path / "take", "rgbd", "take", ["0"], True)
        project.boxes.set_on_image(1, [], BoxKind.BOX, WriteContext(0, "Ada"))
        return project.path


def test_an_open_project_is_backed_up_once_for_its_changes(changed: Path) -> None:
    context = Context(ServerSettings(changed.parent))
    try:
        backups = AutomaticBackups(context)
        backups.make_due()
        assert automatic_backups(changed) == []  # nobody has opened it
        context.project("room")
        for _ in range(2):
            backups.make_due()
        (made,) = automatic_backups(changed, Reason.CHANGES)
        path, manifest = restore(made, changed.parent, "restored")
        assert manifest.last_event == 1 and path.is_dir()
    finally:
        context.close()


def test_a_failed_backup_is_logged_and_tried_again_an_hour_later(
    changed: Path, caplog: pytest.LogCaptureFixture
) -> None:
    in_the_way, now = changed.parent / BACKUPS, [0.0]
    in_the_way.write_text("in the way")
    context = Context(ServerSettings(changed.parent))
    try:
        context.project("room")
        backups = AutomaticBackups(context, lambda: now[0])
        with caplog.at_level(logging.WARNING, "annotator.web"):
            backups.make_due()
            in_the_way.unlink()
            now[0] = BACKUPS_PAUSE_S - 1
            backups.make_due()
        assert ["no automatic backup" in record.message for record in caplog.records] == [True]
        assert automatic_backups(changed) == []
        now[0] = BACKUPS_PAUSE_S
        backups.make_due()
        assert len(automatic_backups(changed)) == 1
    finally:
        context.close()


@pytest.mark.parametrize("has_failed", [False, True])
def test_neither_a_backup_nor_a_failure_of_a_replaced_project_counts_for_the_new_one(
    changed: Path, tmp_path: Path, has_failed: bool
) -> None:
    backup, made = shutil.copytree(changed, tmp_path / "copies" / "room"), changed.parent / BACKUPS
    if has_failed:
        made.write_text("in the way")
    context = Context(ServerSettings(changed.parent))
    try:
        context.project("room")
        backups = AutomaticBackups(context, lambda: 0.0)
        backups.make_due()
        assert len(automatic_backups(changed)) == (not has_failed)
        if has_failed:
            made.unlink()
        else:
            shutil.rmtree(made)
        backups.make_due()
        assert automatic_backups(changed) == []
        replace_folder(changed, backup)
        context.project("room")
        backups.make_due()
        assert len(automatic_backups(changed)) == 1
    finally:
        context.close()


def test_what_a_killed_backup_has_left_is_removed_at_the_next_start(changed: Path) -> None:
    back_up_automatically(changed, Reason.CHANGES)
    left = changed.parent / BACKUPS / "room" / f".room-backup.{'0' * 32}.unfinished"
    left.mkdir()
    clear_leftovers(changed.parent)
    assert not left.exists()


def test_a_round_that_cannot_start_loses_no_event(
    project: Project, jobs: JobRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Learner, name: str, project: Project) -> None:
        raise ConfigError("20 jobs are waiting already")

    monkeypatch.setattr(Learner, "look", fail)
    monkeypatch.setattr(Log, "changed_frames", lambda self, event_id: (event_id + 1, (ChangedFrame(7, 2, "Ada"),)))
    sent: list[int] = []
    hub = SimpleNamespace(
        projects=lambda: {"room": 0},
        frame_changed=lambda name, frame_id, *_: sent.append(frame_id),
        recordings_are=lambda name, ids: None,
    )
    monkeypatch.setattr(Context, "is_open", lambda self, name: True)
    monkeypatch.setattr(Context, "project", lambda self, name: project)
    context = object.__new__(Context)
    vars(context)["hub"] = hub
    watch = Watch(context, Learner(jobs))
    watch.poll()
    assert sent == [7]
