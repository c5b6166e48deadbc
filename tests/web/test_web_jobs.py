"""Jobs: outcomes, order, events to pages, and the journal after a restart; the work is a fake for these tests."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fake_jobs
import pytest
from live_server import PATIENCE_S, ended, look, running
from test_events import listen, next_of

from annotator.formats.rcv import read_rcv
from annotator.project import open_project
from annotator.web.jobs import runner
from annotator.web.jobs.records import FILE, WORK
from annotator.web.jobs.runner import EXPORTS_KEPT, JOBS_KEPT, MOST_WAITING
from annotator.web.jobs.worker import AUTOGROUP, NICENESS

if TYPE_CHECKING:
    from live_server import Live

    from annotator.web.security import ServerSettings

WaitFor = Callable[[Callable[[], Any]], None]
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
    group = str(NICENESS) if os.access(AUTOGROUP, os.W_OK) else None
    assert done["result"] == {"nice": os.nice(0) + NICENESS, "group": group, "omp": "PASSIVE"}
    assert server.client.get("/api/jobs").json()["jobs"] == [done]
    assert server.client.get(f"/api/jobs/{job['id']}/download").status_code == 404


@pytest.mark.parametrize(
    ("what", "message"),
    [
        (fake_jobs.REFUSED, "project room has no image detector yet"),
        (fake_jobs.BUG, "internal error, see the server's log"),
        (fake_jobs.KILLED, "the worker ended unexpectedly (killed, possibly out of memory)"),
    ],
)
def test_a_job_fails_and_the_next_one_runs(server: Live, what: int, message: str) -> None:
    failed, next_one = begin(server, what), begin(server, fake_jobs.QUICK)
    now = ended(server, failed)
    assert (now["state"], now["message"], now["eta_s"]) == ("failed", message, None)
    assert ended(server, next_one)["state"] == "done"


def test_a_running_and_a_waiting_job_can_be_stopped(server: Live) -> None:
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


def test_a_worker_that_does_not_stop_is_killed(server: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "KILL_AFTER_S", 0.5)
    server.context.jobs._grace_s = 0.5
    job = begin(server, fake_jobs.DEAF)
    until(server, job, "running", "deaf")
    server.client.post(f"/api/jobs/{job['id']}/cancel")
    assert ended(server, job)["state"] == "cancelled"
    with open_project(server.settings.projects_root / "room") as project:
        assert project.problems() == []


def test_pages_get_events_for_changes_of_a_job(server: Live) -> None:
    with listen(server) as socket:
        next_of(socket, "presence")
        begin(server, fake_jobs.EDITS)
        event = next_of(socket, "frame")
        assert (event["revision"], event["operator"]) == (1, "a job")


def test_the_server_answers_while_a_job_runs(server: Live) -> None:
    job = begin(server, fake_jobs.LONG)
    until(server, job, "running", "on and on")
    for _ in range(20):
        assert server.client.get("/api/projects/room").status_code == 200
    assert look(server, job["id"])["state"] == "running"


def test_the_number_of_waiting_jobs_is_limited(server: Live) -> None:
    jobs = [begin(server, fake_jobs.LONG)]
    until(server, jobs[0], "running", "on and on")
    jobs += [begin(server, fake_jobs.QUICK) for _ in range(MOST_WAITING)]
    refused = server.client.post(JOBS, json={"kind": "propose", "limit": 1})
    assert (refused.status_code, refused.json()["error"]["kind"]) == (400, "ConfigError")


def test_a_worker_imports_no_file_of_the_current_folder(
    server: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "annotator.py").write_text("raise SystemExit('a foreign file')")
    monkeypatch.chdir(tmp_path)
    assert ended(server, begin(server, fake_jobs.QUICK))["message"] == "counted to 2"


def test_a_restarted_server_lists_former_jobs(fake: None, web_settings: ServerSettings) -> None:
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
        (job,) = live.client.get("/api/jobs").json()["jobs"]
        assert (job["state"], job["message"]) == ("failed", "the server was stopped")
        assert [path.name for path in folder.iterdir()] == [FILE]


@pytest.mark.parametrize("content", ["", "{", '{"jobs": [1]}', '{"others": []}'])
def test_a_server_starts_with_a_damaged_journal(web_settings: ServerSettings, content: str) -> None:
    (web_settings.projects_root / ".jobs").mkdir()
    (web_settings.projects_root / ".jobs" / FILE).write_text(content)
    with running(web_settings) as live:
        assert live.client.get("/api/jobs").json() == {"jobs": []}
        assert [p["name"] for p in live.client.get("/api/projects").json()["projects"]] == ["room"]


def test_a_worker_ends_when_its_server_has_died(fake: None, web_settings: ServerSettings, tmp_path: Path) -> None:
    order = {
        "target": "fake_jobs:work",
        "project": str(web_settings.projects_root / "room"),
        "folder": str(tmp_path),
        "operator": "Ada",
        "request": {"kind": "propose", "limit": fake_jobs.LONG},
    }
    command = [sys.executable, "-m", "annotator.web.jobs.worker"]
    worker = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write(json.dumps(order) + "\n")
    worker.stdin.flush()
    assert "on and on" in worker.stdout.readline()
    worker.stdin.close()
    assert worker.wait(15) == 0
    worker.stdout.close()


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ({"kind": "dance"}, 422),
        ({}, 422),
        ({"kind": "train", "roles": []}, 422),
        ({"kind": "train", "roles": ["both"]}, 422),
        ({"kind": "train", "image_pictures": 0}, 422),
        ({"kind": "train", "model": "../../evil.pt"}, 422),
        ({"kind": "train", "epochs": 1}, 422),
        ({"kind": "propose", "limit": 0}, 422),
        ({"kind": "propose", "recordings": []}, 422),
        ({"kind": "propose", "recordings": [1e99]}, 422),
        ({"kind": "export", "format": "zip"}, 422),
        ({"kind": "import"}, 422),
        ({"kind": "import", "recordings": []}, 422),
        ({"kind": "export", "states": ["new"]}, 422),
        ({"kind": "export", "split": {"shares": "train"}}, 422),
        ({"kind": "export", "split": {"shares": "train=1", "by": "luck"}}, 422),
    ],
)
def test_invalid_jobs_are_refused(server: Live, body: object, status: int) -> None:
    answer = server.client.post(JOBS, json=body)
    assert answer.status_code == status
    assert server.client.get("/api/jobs").json() == {"jobs": []}


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("POST", "/api/projects/nobody/jobs", 404),
        ("POST", f"/api/jobs/{'0' * 32}/cancel", 404),
        ("GET", f"/api/jobs/{'0' * 32}/download", 404),
        ("GET", "/api/jobs/..%2Fjournal.json/download", 404),
        ("GET", "/api/jobs/journal.json/download", 422),
    ],
)
def test_missing_jobs_and_files_are_404(server: Live, method: str, path: str, status: int) -> None:
    body = {"kind": "propose"} if method == "POST" and path.endswith("jobs") else None
    assert server.client.request(method, path, json=body).status_code == status


def test_export_and_download(live: Live, generated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # one is enough here, since each export starts a process; the next test covers the limit
    monkeypatch.setattr(runner, "EXPORTS_KEPT", 1)
    nothing = live.client.post(JOBS, json={"kind": "export"}).json()
    assert "no labels in state" in ended(live, nothing)["message"]
    live.client.post("/api/projects", json={"name": "full", "classes": ["person"]})
    added = live.client.post("/api/projects/full/recordings", json={"path": f"{generated.name}/people"}).json()
    assert ended(live, added["job"])["state"] == "done"
    jobs = []
    for _ in range(2):
        jobs.append(live.client.post("/api/projects/full/jobs", json={"kind": "export"}).json())
        assert ended(live, jobs[-1])["message"] == "15 boxes in 5 frames"
    answer = live.client.get(f"/api/jobs/{jobs[-1]['id']}/download")
    assert answer.headers["content-type"] == "application/zip"
    assert 'filename="full-rcv.zip"' in answer.headers["content-disposition"]
    zipfile.ZipFile(BytesIO(answer.content)).extractall(tmp_path / "out")
    dataset = read_rcv(tmp_path / "out" / "full-rcv")
    assert sum(len(dataset.labels(index)) for index in range(len(dataset))) == 15
    end = time.monotonic() + PATIENCE_S
    while look(live, jobs[0]["id"])["download"] != "gone":  # the runner tidies up once a job has ended
        assert time.monotonic() < end
        time.sleep(0.05)
    gone = live.client.get(f"/api/jobs/{jobs[0]['id']}/download")
    assert gone.status_code == 404
    assert [look(live, job["id"])["download"] for job in (nothing, *jobs)] == [None, "gone", "kept"]
    folders = [path for path in (live.settings.projects_root / ".jobs").iterdir() if path.is_dir()]
    assert [sorted(p.name for p in folder.iterdir()) for folder in folders] == [["full-rcv.zip", "worker.log"]]
    formats = {entry["name"]: entry for entry in live.client.get("/api/export-formats").json()["formats"]}
    assert "proposed" in formats["rcv"]["states"] and "proposed" not in formats["kitti"]["states"]
    assert [name for name, entry in formats.items() if entry["flat"]] == ["coco", "yolo"]
    split = {"shares": "train=3,val=2", "seed": 4}
    request = {"kind": "export", "format": "kitti", "states": ["accepted"], "recordings": [1], "split": split}
    kitti = ended(live, live.client.post("/api/projects/full/jobs", json=request).json())
    assert kitti["state"] == "done", kitti["message"]
    assert kitti["result"]["splits"] == {"train": 3, "val": 2}
    assert any("clouds have colours" in line for line in kitti["result"]["lost"])
    packed = live.client.get(f"/api/jobs/{kitti['id']}/download").content
    with zipfile.ZipFile(BytesIO(packed)) as archive:
        assert len(archive.read("full-kitti/ImageSets/val.txt").split()) == 2


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
            listed = {int(job["id"], 16): job for job in live.client.get("/api/jobs").json()["jobs"]}
            kept = {number for number, job in listed.items() if job["download"] == "kept"}
            assert kept == {1, *numbers[-EXPORTS_KEPT:]}, "exports of other projects do not count"
            assert len(listed) == JOBS_KEPT + len(kept)
            for number in kept:
                assert live.client.get(f"/api/jobs/{number:032x}/download").content == b"zip"
    shutil.rmtree(folder / f"{1:032x}")
    with running(web_settings) as live:
        assert look(live, f"{1:032x}")["download"] == "gone"
