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
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import fake_jobs
import pytest
from drawing import Scene
from live_server import PATIENCE_S, ended, look, running
from room_api import ROOM
from test_events import listen, next_of

from annotator.detection import pretrained
from annotator.detection.pretrained import TITLE
from annotator.project import WriteContext, open_project
from annotator.project.log.event_types import ImageBoxesSet
from annotator.rcv.config import AGNOSTIC_LABELS
from annotator.types import Box2D, BoxKind, DetectorKind
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.web.jobs import runner, work
from annotator.web.jobs.records import (
    FILE,
    WORK,
    ExportRequest,
    JobContext,
    JobStoppedError,
    LiftRequest,
    Progress,
    ProposeRequest,
    TrainRequest,
    WorkerMessage,
    read_journal,
)
from annotator.web.jobs.runner import EXPORTS_KEPT, JOBS_KEPT, MOST_WAITING
from annotator.web.jobs.work import export_work, propose_work, train_work
from annotator.web.jobs.worker import NICENESS
from annotator.web.schemas import Box2DJson
from annotator.workflows.recorded.own_labels import import_own_labels
from annotator.workflows.workbench.loaded_detectors import ReadyDetector

if TYPE_CHECKING:
    from live_server import Live

    from annotator.types import Detector, Image
    from annotator.web.security import ServerSettings
    from annotator.workflows.detectors import Detectors


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
    group = done["result"]["group"]
    assert group in (NICENESS, None)
    assert done["result"] == {"nice": os.nice(0) + NICENESS, "group": group, "omp": "PASSIVE"}
    assert server.client.get("/api/jobs").json()["jobs"] == [done]
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


def test_a_worker_that_does_not_stop_is_killed(server: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "KILL_AFTER_S", 0.5)
    server.context.jobs._grace_s = 0.5
    job = begin(server, fake_jobs.DEAF)
    until(server, job, "running", "deaf")
    server.client.post(f"/api/jobs/{job['id']}/cancel")
    assert ended(server, job)["state"] == "cancelled"
    with open_project(server.settings.projects_root / "room") as project:
        assert project.problems() == []


def test_pages_get_events_for_changes_of_a_job(server: Live, in_threads: None) -> None:
    with listen(server) as socket:
        next_of(socket, "presence")
        begin(server, fake_jobs.EDITS)
        event = next_of(socket, "frame")
        assert (event["revision"], event["operator"]) == (1, "a job")


def test_the_number_of_waiting_jobs_is_limited(server: Live, in_threads: None) -> None:
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
        (job,) = live.client.get("/api/jobs").json()["jobs"]
        assert (job["state"], job["message"]) == ("failed", "the server was stopped")
        assert [path.name for path in folder.iterdir()] == [FILE]


def test_a_damaged_journal_is_an_empty_one(tmp_path: Path) -> None:
    for content in ("", "{", '{"jobs": [1]}', '{"others": []}'):
        (tmp_path / FILE).write_text(content)
        assert read_journal(tmp_path) == []


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


INVALID = [
    {"kind": "dance"},
    {},
    {"kind": "train", "roles": []},
    {"kind": "train", "image_pictures": 0},
    {"kind": "train", "model": "../../evil.pt"},
    {"kind": "train", "epochs": 1},
    {"kind": "propose", "limit": 0},
    {"kind": "propose", "recordings": []},
    {"kind": "export", "format": "zip"},
    {"kind": "import"},
    {"kind": "export", "states": ["new"]},
    {"kind": "export", "split": {"shares": "train"}},
    {"kind": "export", "split": {"shares": "train=1", "by": "luck"}},
]


def test_invalid_and_missing_jobs_are_refused(server: Live) -> None:
    for body in INVALID:
        assert server.client.post(JOBS, json=body).status_code == 422
    for method, path, status in (
        ("POST", "/api/projects/nobody/jobs", 404),
        ("POST", f"/api/jobs/{'0' * 32}/cancel", 404),
        ("GET", f"/api/jobs/{'0' * 32}/download", 404),
        ("GET", "/api/jobs/..%2Fjournal.json/download", 404),
        ("GET", "/api/jobs/journal.json/download", 422),
    ):
        body = {"kind": "propose"} if path.endswith("jobs") else None
        assert server.client.request(method, path, json=body).status_code == status
    assert server.client.get("/api/jobs").json() == {"jobs": []}


def test_export_and_download(live: Live, generated: Path, tmp_path: Path) -> None:
    project = live.context.project("room")
    job = JobContext(project, tmp_path, "Ada", lambda _: None, lambda: False)
    with pytest.raises(ConfigError, match="no labels in state"):
        export_work(job, ExportRequest(kind="export"))
    import_own_labels(project, 1)
    split = {"shares": "train=3,val=2", "seed": 4}
    request = {"kind": "export", "format": "kitti", "states": ["accepted"], "recordings": [1], "split": split}
    done = ended(live, live.client.post(JOBS, json=request).json())
    assert (done["state"], done["message"]) == ("done", "15 boxes in 5 frames")
    assert done["result"]["splits"] == {"train": 3, "val": 2}
    assert any("clouds have colours" in line for line in done["result"]["lost"])
    answer = live.client.get(f"/api/jobs/{done['id']}/download")
    assert answer.headers["content-type"] == "application/zip"
    assert 'filename="room-kitti.zip"' in answer.headers["content-disposition"]
    with zipfile.ZipFile(BytesIO(answer.content)) as archive:
        assert len(archive.read("room-kitti/ImageSets/val.txt").split()) == 2
    assert done["download"] == "kept"
    folder = live.settings.projects_root / ".jobs" / done["id"]
    assert sorted(path.name for path in folder.iterdir()) == ["room-kitti.zip", "worker.log"]
    formats = {entry["name"]: entry for entry in live.client.get("/api/export-formats").json()["formats"]}
    assert "proposed" in formats["rcv"]["states"] and "proposed" not in formats["kitti"]["states"]
    assert [name for name, entry in formats.items() if entry["flat"]] == ["coco", "yolo"]


def test_missing_training_data_is_reported(live: Live, tmp_path: Path) -> None:
    job = JobContext(live.context.project("room"), tmp_path, "Ada", lambda _: None, lambda: False)
    with pytest.raises(AnnotatorError, match="to learn from"):
        train_work(job, TrainRequest(kind="train"))
    with pytest.raises(AnnotatorError, match="detector yet"):
        propose_work(job, ProposeRequest(kind="propose"))


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


MODELS = "/api/projects/room/models"


def test_a_project_without_models(live: Live) -> None:
    answer = live.client.get(MODELS).json()
    assert answer.pop("base") in (None, "in use")
    assert answer == {
        "models": [],
        "learn_every": None,
        "material": {"image": 0, "view": 0, "labels": 0, "to_lift": 0},
    }
    for method, path in (
        ("POST", f"{MODELS}/1/activate"),
        ("GET", f"{MODELS}/1/pictures/0.jpg"),
        ("GET", "/api/projects/nobody/models"),
    ):
        assert live.client.request(method, path).status_code == 404
    assert live.client.get(f"{MODELS}/{10**30}/pictures/0.jpg").status_code == 422
    assert live.client.get(f"{MODELS}/x/pictures/0.jpg").status_code == 422


def test_detectors_are_loaded_at_once_when_the_page_asks(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    detectors = live.context.caches.detectors
    monkeypatch.setattr(detectors, "warm", lambda project: asked.append(project.path.name))
    assert live.client.post(f"{MODELS}/load").status_code == 204
    assert asked == ["room"]


class AnyClass:
    """As a base detector: the boxes of another detector without their classes."""

    labels = tuple(AGNOSTIC_LABELS.values())
    fingerprint = "any class"

    def __init__(self, detector: Detector) -> None:
        self._detector = detector

    def detect(self, images: list[Image]) -> list[list[Box2D]]:
        return [[replace(box, label="whole") for box in boxes] for boxes in self._detector.detect(images)]


@pytest.fixture
def base(knowing: Callable[..., Detectors]) -> ReadyDetector:
    return ReadyDetector(AnyClass(knowing("people").view), BoxKind.BOX, Lock(), True, pretrained.NAME)


def test_the_job_proposes_3d_boxes_and_says_what_measured_them(
    live: Live, generated: Path, tmp_path: Path, base: ReadyDetector, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(work, "require_view", lambda _: base)
    project = live.context.project("room")
    sent: list[WorkerMessage] = []
    job = JobContext(project, tmp_path, "Ada", sent.append, lambda: False)
    with pytest.raises(ConfigError, match="no frame has boxes on its image but no 3D box"):
        work.lift_work(job, LiftRequest(kind="lift"))
    scene, stored = Scene.of(generated / "people", 0, ["person"]), project.frames.of()[0]
    boxes = tuple(Box2DJson(**scene.image_box(number)).box() for number in range(len(scene.objects)))
    drawn = ImageBoxesSet(boxes=boxes, box_kind=BoxKind.SILHOUETTE)
    project.log.append(stored.id, [drawn], WriteContext(stored.revision, "Ada"))
    assert live.client.get(f"{ROOM}/models").json()["material"]["to_lift"] == 1
    stopped = JobContext(project, tmp_path, "Ada", sent.append, lambda: True)
    with pytest.raises(JobStoppedError):
        work.lift_work(stopped, LiftRequest(kind="lift"))
    outcome = work.lift_work(job, LiftRequest(kind="lift"))
    assert outcome.result["proposals"] > 0 and outcome.result["frames"] == 1
    assert outcome.message.endswith(f"proposals in 1 frame, measured by: {TITLE}")
    assert any(isinstance(message, Progress) and message.total == 1.0 for message in sent)
    assert live.client.get(f"{ROOM}/models").json()["material"]["to_lift"] == 0
    labels = live.client.get(f"{ROOM}/frames/{stored.id}").json()["labels"]
    assert {label["measured_by"] for label in labels} == {TITLE}


def test_the_project_and_its_statistics_name_the_base_detector_until_it_has_its_own(
    live: Live, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def named() -> tuple[str | None, str | None]:
        statistics = live.client.get(f"{ROOM}/statistics").json()
        return live.client.get(ROOM).json()["detectors"]["stand_in"], statistics["view_detector"]

    assert named() == (None, None)
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "detector.safetensors").write_bytes(b"weights")
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path / "base")
    assert named() == (TITLE, TITLE)
    project = live.context.project("room")
    weights = project.path / "models" / "own.pt"
    weights.parent.mkdir(exist_ok=True)
    weights.write_bytes(b"w")
    kind = {"labels": ["person"], "box_kind": BoxKind.BOX, "metrics": {}, "fingerprint": "own"}
    project.models.register(DetectorKind.VIEW, weights, **kind)
    assert named() == (None, "this project's view detector")
