"""Jobs: outcomes, order, events to pages, the journal after a restart, and what a server does beside requests.

The work of the jobs is a fake for these tests.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import subprocess
import time
import zipfile
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fake_jobs
import pytest
from live_server import PATIENCE_S, ended, look, running
from test_annotation_api import listen, next_of

from annotator.child import Child
from annotator.project import Project, WriteContext, create_project, open_project
from annotator.project.backup.make import Reason, automatic_backups
from annotator.project.backup.take_in import restore
from annotator.project.config import BACKUPS
from annotator.project.labels import Labels
from annotator.project.models import Models
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError
from annotator.web import background
from annotator.web.background import BACKUPS_PAUSE_S, AutomaticBackups, Learner, Problems
from annotator.web.context import Context
from annotator.web.jobs import runner, worker
from annotator.web.jobs.records import (
    FILE,
    PAUSE,
    WORK,
    Ended,
    JobState,
    Order,
    ProposeRequest,
    TrainRequest,
    WorkerMessage,
    expected_s,
    read_journal,
)
from annotator.web.jobs.runner import EXPORTS_KEPT, JOBS_KEPT, WORKER, JobRunner
from annotator.web.jobs.worker import NICENESS
from annotator.web.security import ServerSettings
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.training.held_out import Decision

if TYPE_CHECKING:
    from live_server import Live


JOBS = "/api/projects/room/jobs"
ENDS = ("done", "failed", "cancelled")


@pytest.fixture
def fake(jobs_on_path: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Proposing is replaced by the work of `fake_jobs`."""
    monkeypatch.setitem(WORK, "propose", "fake_jobs:work")


@pytest.fixture
def server(fake: None, live: Live) -> Iterator[Live]:
    yield live


def begin(live: Live, what: int) -> dict[str, Any]:
    answer = live.client.post(JOBS, json={"kind": "propose", "limit": what})
    assert answer.status_code == 201, answer.text
    job: dict[str, Any] = answer.json()
    return job


def until(live: Live, job: dict[str, Any], state: str, stage: str) -> None:
    end = time.monotonic() + PATIENCE_S
    while (now := look(live, job["id"]))["state"] != state or now["stage"] != stage:
        assert time.monotonic() < end and now["state"] not in ENDS, now
        time.sleep(0.05)


def test_a_job_runs_and_reports_progress_and_result(server: Live) -> None:
    with listen(server) as socket:
        job = begin(server, fake_jobs.QUICK)
        assert (job["project"], job["kind"], job["operator"]) == ("room", "propose", "Ada")
        assert job["state"] in ("queued", "running")
        states = []
        while not states or states[-1] != "done":
            states.append(next_of(socket, "job")["job"]["state"])
    assert list(dict.fromkeys(states)) == ["queued", "running", "done"]
    done = ended(server, job)
    assert (done["message"], done["done"], done["total"]) == ("counted to 2", 2.0, 2.0)
    assert done["curves"] == [{"role": "image", "epoch": 1, "metrics": {"map50": 0.5}}]
    group = done["result"]["group"]
    assert group in (NICENESS, None)
    assert done["result"] == {"nice": min(os.nice(0) + NICENESS, 19), "group": group, "omp": "PASSIVE"}
    assert server.client.get("/api/jobs").json() == [done]
    assert server.client.get(f"/api/jobs/{job['id']}/download").status_code == 404


def test_a_job_whose_worker_is_killed_fails(server: Live) -> None:
    now = ended(server, begin(server, fake_jobs.KILLED))
    said = "the worker ended unexpectedly (killed, possibly out of memory)"
    assert (now["state"], now["message"], now["eta_s"]) == ("failed", said, None)


def test_jobs_fail_and_the_next_one_runs(server: Live, in_threads: None) -> None:
    messages = {
        fake_jobs.REFUSED: "project room has no image detector yet",
        fake_jobs.BUG: "internal error, see the server's log",
    }
    *failed, next_one = [begin(server, what) for what in (*messages, fake_jobs.QUICK)]
    for job, message in zip(failed, messages.values(), strict=True):
        now = ended(server, job)
        assert (now["state"], now["message"], now["eta_s"]) == ("failed", message, None)
    assert ended(server, next_one)["state"] == "done"


def test_a_running_and_a_waiting_job_can_be_stopped(server: Live, in_threads: None) -> None:
    runs, waits, last = (begin(server, what) for what in (fake_jobs.LONG, fake_jobs.LONG, fake_jobs.QUICK))
    until(server, runs, "running", "on and on")
    assert look(server, waits["id"])["state"] == "queued"
    stopped = server.client.post(f"/api/jobs/{waits['id']}/cancel").json()
    assert (stopped["state"], stopped["message"]) == ("cancelled", "stopped before it began")
    assert server.client.post(f"/api/jobs/{runs['id']}/cancel").json()["stage"] == "stopping"
    assert ended(server, runs)["state"] == "cancelled"
    assert ended(server, last)["state"] == "done"
    again = server.client.post(f"/api/jobs/{runs['id']}/cancel").json()
    assert again["state"] == "cancelled"


def test_a_job_that_reads_and_writes_files_does_not_wait_for_a_training(
    server: Live, in_threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(WORK, "import", "fake_jobs:work")
    runs, waits = begin(server, fake_jobs.LONG), begin(server, fake_jobs.QUICK)
    until(server, runs, "running", "on and on")
    brings = server.client.post(JOBS, json={"kind": "import", "recordings": [1]}).json()
    assert ended(server, brings)["message"] == "counted to 2"
    assert [look(server, job["id"])["state"] for job in (runs, waits)] == ["running", "queued"]
    server.client.post(f"/api/jobs/{runs['id']}/cancel")
    assert ended(server, waits)["state"] == "done"


def test_a_worker_that_does_not_stop_is_killed(server: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "KILL_AFTER_S", 0.5)
    monkeypatch.setattr(runner, "GRACE_S", 0.5)
    job = begin(server, fake_jobs.DEAF)
    until(server, job, "running", "deaf")
    server.client.post(f"/api/jobs/{job['id']}/cancel")
    assert ended(server, job)["state"] == "cancelled"
    with open_project(server.settings.projects_root / "room") as project:
        assert project.problems() == []


def test_a_worker_imports_no_file_of_the_current_folder(
    server: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "annotator.py").write_text("raise SystemExit('a foreign file')")
    monkeypatch.chdir(tmp_path)
    assert ended(server, begin(server, fake_jobs.QUICK))["message"] == "counted to 2"


def test_a_restarted_server_lists_former_jobs(fake: None, in_threads: None, web_settings: ServerSettings) -> None:
    with running(web_settings) as live:
        done, runs, waits = (begin(live, what) for what in (fake_jobs.QUICK, fake_jobs.LONG, fake_jobs.QUICK))
        until(live, runs, "running", "on and on")
    with running(web_settings) as live:
        assert ended(live, done)["message"] == "counted to 2"
        for job in (runs, waits):
            now = look(live, job["id"])
            assert (now["state"], now["message"]) == ("failed", "the server was stopped")


def test_jobs_of_a_killed_server_become_failed(fake: None, web_settings: ServerSettings) -> None:
    folder = web_settings.projects_root / ".jobs"
    folder.mkdir()
    record = {"id": "0" * 32, "project": "room", "kind": "train", "state": "running", "created_ns": 1, "operator": "A"}
    (folder / FILE).write_text(json.dumps({"jobs": [record]}))
    (folder / ("0" * 32)).mkdir()
    with running(web_settings) as live:
        (job,) = live.client.get("/api/jobs").json()
        assert (job["state"], job["message"]) == ("failed", "the server was stopped")
        assert [path.name for path in folder.iterdir()] == [FILE]


def test_a_damaged_journal_is_an_empty_one(tmp_path: Path) -> None:
    for content in ("", "{", '{"jobs": [1]}', '{"others": []}'):
        (tmp_path / FILE).write_text(content)
        assert read_journal(tmp_path) == []


def test_a_worker_ends_when_its_server_has_died(fake: None, web_settings: ServerSettings, tmp_path: Path) -> None:
    order = Order(
        target="fake_jobs:work",
        project=web_settings.projects_root / "room",
        folder=tmp_path,
        operator="Ada",
        request=ProposeRequest(kind="propose", limit=fake_jobs.LONG),
    )
    worker = Child(WORKER, errors=subprocess.DEVNULL)
    worker.send(order)
    assert worker.receive().stage == "on and on"
    assert worker.process.stdin is not None
    worker.process.stdin.close()
    assert worker.process.wait(15) == 0
    worker.close()


def test_a_worker_ends_well_while_it_waits_for_orders(fake: None, web_settings: ServerSettings, tmp_path: Path) -> None:
    order = Order(
        target="fake_jobs:work",
        project=web_settings.projects_root / "room",
        folder=tmp_path,
        operator="Ada",
        request=ProposeRequest(kind="propose", limit=fake_jobs.QUICK),
    )
    worker = Child(WORKER, {"OMP_WAIT_POLICY": "PASSIVE"}, subprocess.DEVNULL)
    worker.send(order)
    messages: list[WorkerMessage] = []
    with pytest.raises(EOFError):
        while True:
            messages.append(worker.receive())
    assert isinstance(messages[-1], Ended) and messages[-1].message == "counted to 2"
    assert worker.process.wait(15) == 0
    worker.close()


INVALID = (
    {"kind": "dance"},
    {"kind": "train", "model": "../../evil.pt"},
    {"kind": "train", "epochs": 1},
    {"kind": "propose", "limit": 0},
    {"kind": "export", "states": ["new"]},
    {"kind": "export", "split": {"shares": "train"}},
)


def test_invalid_and_missing_jobs_are_refused(server: Live) -> None:
    for body in INVALID:
        assert server.client.post(JOBS, json=body).status_code == 422
    assert server.client.post("/api/projects/nobody/jobs", json={"kind": "propose"}).status_code == 404
    assert server.client.post(f"/api/jobs/{'0' * 32}/cancel").status_code == 404
    assert server.client.get(f"/api/jobs/{'0' * 32}/download").status_code == 404
    assert server.client.get("/api/jobs").json() == []


def test_export_and_download(live: Live) -> None:
    import_own_labels(live.context.project("room"), 1)
    split = {"shares": "train=3,val=2", "seed": 4}
    request = {"kind": "export", "format": "kitti", "states": ["accepted"], "recordings": [1], "split": split}
    done = ended(live, live.client.post(JOBS, json=request).json())
    assert (done["state"], done["message"], done["download"]) == ("done", "15 boxes in 5 frames", "kept")
    assert any("clouds have colours" in line for line in done["result"]["lost"])
    answer = live.client.get(f"/api/jobs/{done['id']}/download")
    assert 'filename="room-kitti.zip"' in answer.headers["content-disposition"]
    with zipfile.ZipFile(BytesIO(answer.content)) as archive:
        assert len(archive.read("room-kitti/ImageSets/val.txt").split()) == 2
    folder = live.settings.projects_root / ".jobs" / done["id"]
    assert sorted(path.name for path in folder.iterdir()) == ["room-kitti.zip", "worker.log"]
    formats = {entry["name"]: entry for entry in live.client.get("/api/export-formats").json()}
    assert "proposed" in formats["rcv"]["states"] and "proposed" not in formats["kitti"]["states"]
    assert [name for name, entry in formats.items() if entry["flat"]] == ["coco", "yolo"]


def test_the_latest_exports_of_each_project_are_kept(fake: None, web_settings: ServerSettings) -> None:
    folder = web_settings.projects_root / ".jobs"
    numbers = range(1, EXPORTS_KEPT + JOBS_KEPT + 10)
    records = []
    for number in numbers:
        name = f"{number:032x}"
        (folder / name).mkdir(parents=True)
        (folder / name / "room-rcv.zip").write_bytes(b"zip")
        project = "quiet" if number == 1 else "room"
        record = {"id": name, "project": project, "kind": "export", "state": "done", "created_ns": number}
        records.append({**record, "operator": "A", "result": {"file": "room-rcv.zip"}})
    (folder / FILE).write_text(json.dumps({"jobs": records}))
    for _ in range(2):
        with running(web_settings) as live:
            listed = {int(job["id"], 16): job for job in live.client.get("/api/jobs").json()}
            kept = {number for number, job in listed.items() if job["download"] == "kept"}
            assert kept == {1, *numbers[-EXPORTS_KEPT:]}, "exports of other projects do not count"
            assert len(listed) == JOBS_KEPT + len(kept)
            for number in kept:
                assert live.client.get(f"/api/jobs/{number:032x}/download").content == b"zip"
    shutil.rmtree(folder / f"{1:032x}")
    with running(web_settings) as live:
        assert look(live, f"{1:032x}")["download"] == "gone"


MODELS = "/api/projects/room/models"
MATERIAL = ("image", "view", "labels", "to_lift")


def test_a_project_without_models(live: Live) -> None:
    answer = live.client.get(MODELS).json()
    assert answer.pop("base") in (None, "in use")
    assert answer == {"models": [], "learn_every": None, "learn_minutes": 3.0, "material": dict.fromkeys(MATERIAL, 0)}
    assert live.client.put(f"{MODELS}/learning", json={"every": 0}).status_code == 422
    assert live.client.post(f"{MODELS}/1/activate").status_code == 404
    assert live.client.get(f"{MODELS}/1/pictures/0.jpg").status_code == 404
    assert live.client.get(f"{MODELS}/{10**30}/pictures/0.jpg").status_code == 422


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
def learning(live: Live, fake: None, in_threads: None, monkeypatch: pytest.MonkeyPatch) -> Live:
    monkeypatch.setitem(WORK, "train", "fake_jobs:train")
    return live


def end_all(jobs: JobRunner, state: JobState = JobState.DONE) -> None:
    for job in jobs.all():
        jobs._update(job.id, state=state)
    jobs._tasks.clear()


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


def test_a_job_in_the_background_stops_for_another_job_and_begins_again(learning: Live) -> None:
    job: dict[str, Any] = learning.client.post(JOBS, json=ROUND).json()
    assert job["background"] is True
    for _ in range(2):
        until(learning, job, "running", "learn")
        assert ended(learning, begin(learning, fake_jobs.QUICK))["state"] == "done"
    until(learning, job, "running", "learn")
    learning.client.post(f"/api/jobs/{job['id']}/cancel")
    job = ended(learning, job)
    # not also the points of the rounds that were stopped
    assert (job["state"], len(job["curves"])) == ("cancelled", 1)


def test_a_job_in_the_background_waits_while_a_frame_is_worked_on(
    learning: Live, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "PAUSE_S", 600.0)
    job = learning.client.post(JOBS, json=ROUND).json()
    until(learning, job, "running", "learn")
    assert learning.client.get("/api/projects/room/frames/1").status_code == 200
    time.sleep(0.3)
    before = look(learning, job["id"])["done"]
    time.sleep(0.3)
    assert look(learning, job["id"])["done"] == before
    # a job that is paused can be stopped, and goes on by itself
    learning.client.post(f"/api/jobs/{job['id']}/cancel")
    assert ended(learning, job)["state"] == "cancelled"
    monkeypatch.setattr(worker, "PAUSE_S", 0.05)
    (orders := worker.Orders()).take(PAUSE)
    began = time.monotonic()
    assert not orders.stopped() and time.monotonic() - began >= 0.05


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
        assert manifest.last_event == 2 and path.is_dir()
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


def test_what_is_wrong_with_a_project_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    problems = Problems()
    for name, text in (("a", "1"), ("a", "1"), ("b", "1"), ("a", "2"), ("a", ""), ("a", "2")):
        with caplog.at_level(logging.WARNING, "annotator.web"), problems.of(name, "not looked at"):
            if text:
                raise ConfigError(text)
    assert [record.message for record in caplog.records] == [
        f"{name}: not looked at: {text}" for name, text in (("a", "1"), ("b", "1"), ("a", "2"), ("a", "2"))
    ]


def test_the_minutes_of_a_training_tell_how_long_it_takes_before_its_progress_does() -> None:
    assert expected_s(TrainRequest(kind="train", minutes=2)) == 240
    assert expected_s(TrainRequest(kind="train", roles=["view"], minutes=0.5)) == 30
    assert expected_s(TrainRequest(kind="train")) is None
