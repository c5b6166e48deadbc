"""Folders of projects that somebody sent, on a running server: nothing outside of them is read or written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from live_server import Live, running

from annotator.project import Project
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import ConfigError, RecordingError
from annotator.web.context import Context
from annotator.web.security import ServerSettings

ROOM = "/api/projects/room"
SECRET = b"\xff\xd8 not for others"
JOB = {"project": "room", "kind": "export", "state": "done", "created_ns": 1, "operator": "Eve"}


def model(project: Project) -> Path:
    """Registers a model; returns its folder."""
    folder = project.models_folder / "view" / "run"
    (folder / "validation").mkdir(parents=True)
    (folder / "detector.safetensors").write_bytes(b"weights")
    facts = {"labels": ["person"], "box_kind": BoxKind.BOX, "metrics": {}, "fingerprint": "f"}
    project.models.register(DetectorKind.VIEW, folder / "detector.safetensors", activate=False, **facts)
    return folder


def test_no_link_is_served(live: Live, tmp_path: Path) -> None:
    secret = tmp_path / "secret.jpg"
    secret.write_bytes(SECRET)
    project = live.context.project("room")
    (model(project) / "validation" / "0.jpg").symlink_to(secret)
    view = "0" * 64
    (project.path / "views" / f"{view}.png").symlink_to(secret)
    for path in (f"{ROOM}/models/1/pictures/0.jpg", f"{ROOM}/views/{view}.png"):
        answer = live.client.get(path)
        assert answer.status_code == 404
        assert SECRET not in answer.content
    assert live.client.get(f"{ROOM}/models").json()["models"][0]["pictures"] == []


def test_a_project_with_a_link_out_of_it_is_a_card_that_says_so(web_settings: ServerSettings, tmp_path: Path) -> None:
    (web_settings.projects_root / "room" / "models" / "view").symlink_to(tmp_path)
    with running(web_settings) as live:
        (card,) = live.client.get("/api/projects").json()["projects"]
        assert card["problem"].startswith("projects/room/models/view: is a link that leads out of the project")
        assert live.client.get(ROOM).status_code >= 400


@pytest.mark.parametrize(
    ("changes", "is_listed"),
    [
        ({"id": "../../outside"}, False),
        ({"id": "a" * 32, "result": {"file": "../../../outside/secret.zip"}}, True),
        ({"id": "b" * 32, "result": {"file": "secret.zip"}}, True),  # its folder is a link
    ],
)
def test_a_journal_offers_no_file_of_other_folders(
    web_settings: ServerSettings, tmp_path: Path, changes: dict[str, object], is_listed: bool
) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret.zip").write_bytes(SECRET)
    jobs = web_settings.projects_root / ".jobs"
    (jobs / ("a" * 32)).mkdir(parents=True)
    content = {"jobs": [{"result": {"file": "secret.zip"}, **JOB, **changes}]}
    (jobs / "journal.json").write_text(json.dumps(content), encoding="utf-8")
    with running(web_settings) as live:
        if changes["id"] == "b" * 32:
            (jobs / ("b" * 32)).symlink_to(tmp_path / "outside")
        assert len(live.client.get("/api/jobs").json()["jobs"]) == is_listed
        answer = live.client.get(f"/api/jobs/{changes['id']}/download".replace("../", "%2e%2e%2f"))
        assert answer.status_code in (404, 422)
        assert SECRET not in answer.content
    assert (tmp_path / "outside" / "secret.zip").read_bytes() == SECRET


@pytest.mark.parametrize("place", [".jobs", ".jobs/lock", ".jobs/journal.json", f".jobs/{'b' * 32}"])
def test_a_folder_of_jobs_with_a_link_out_of_it_is_refused(
    web_settings: ServerSettings, tmp_path: Path, place: str
) -> None:
    file = web_settings.projects_root / place
    file.parent.mkdir(exist_ok=True)
    file.symlink_to(tmp_path / "generated")
    with pytest.raises(ConfigError, match=rf"{place}: is a link .* remove it"):
        Context(web_settings)


def test_other_computers_see_no_recordings_outside_the_offered_folders(
    web_settings: ServerSettings, generated: Path, tmp_path: Path
) -> None:
    for folders, is_read in (((generated,), True), ((tmp_path,), False), ((), False)):
        context = Context(replace(web_settings, host="0.0.0.0", token="t" * 32, folders=folders))
        project = context.project("room")
        frame = project.frames.of()[0]
        if is_read:
            assert context.frame(project, frame.id).rgb is not None
        else:
            with pytest.raises(RecordingError, match="people lies outside the folders that this server offers"):
                context.frame(project, frame.id)
        context.close()
