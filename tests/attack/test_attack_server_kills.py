"""`kill -9` of the server while operators save and a job writes a dataset."""

from __future__ import annotations

import io
import random
import threading
import time
import zipfile

import httpx
import pytest
from live_server import PATIENCE_S, wait_until
from sound import require_sound
from test_kill_server import EDITS_BEFORE_KILL, Editor, server

from annotator.project import open_project
from annotator.web.security import ServerSettings

# 20 kills on a busy machine
pytestmark = pytest.mark.timeout(3600)
EDITORS = 2
LONGEST_S = 6.0


def test_a_killed_server_loses_no_acknowledged_save_and_offers_no_half_export(
    web_settings: ServerSettings, times: int, chance: random.Random
) -> None:
    room = web_settings.projects_root / "room"
    for number in range(times):
        with server(web_settings.projects_root) as (url, process):
            _require_whole_downloads(url)
            editors = [
                Editor(url, 1 + (number + other) % 5, 100 * number + other, f"ann {number} {other}")
                for other in range(EDITORS)
            ]
            threads = [threading.Thread(target=editor.run) for editor in editors]
            for thread in threads:
                thread.start()
            wait_until(lambda editors=editors: all(each.acknowledged > EDITS_BEFORE_KILL for each in editors))  # type: ignore[misc]
            headers = {"Origin": url}
            with httpx.Client(base_url=url, headers=headers, timeout=PATIENCE_S) as client:
                client.post("/api/session", json={"operator": "ann"})
                job = client.post("/api/projects/room/jobs", json={"kind": "export", "format": "kitti"})
                assert job.status_code == 201, job.text
            time.sleep(chance.uniform(0.0, LONGEST_S))
            process.kill()
            process.wait()
            for thread in threads:
                thread.join(PATIENCE_S)
        require_sound(room)
        with open_project(room) as project:
            for editor in editors:
                editor.require_kept(project)


def _require_whole_downloads(url: str) -> None:
    """Every job of the last server has ended, and what it offers can be downloaded as a whole."""
    with httpx.Client(base_url=url, headers={"Origin": url}, timeout=PATIENCE_S) as client:
        client.post("/api/session", json={"operator": "ann"})
        for job in client.get("/api/jobs").json()["jobs"]:
            assert job["state"] not in ("queued", "running"), job
            if job["state"] == "done":
                file = client.get(f"/api/jobs/{job['id']}/download")
                assert file.status_code in (200, 404), file.text
                if file.status_code == 200:
                    assert file.content[:2] == b"PK"
                    _require_zip(file.content)


def _require_zip(content: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist()
