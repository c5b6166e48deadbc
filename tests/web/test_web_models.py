"""Models through the API, and one real training, proposal and export in worker processes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from test_events import listen, next_of
from test_web_jobs import JOBS, ended

from annotator.project import Change, NewLabel, open_project
from annotator.recordings import open_recording
from annotator.types import Source
from annotator.workflows.truth import load_truth

if TYPE_CHECKING:
    from pathlib import Path

    from live_server import Live

MODELS = "/api/projects/room/models"


def test_a_project_without_models(live: Live) -> None:
    answer = live.client.get(MODELS).json()
    assert answer == {"models": [], "material": {"image": 0, "view": 0, "labels": 0}}
    for method, path in (
        ("POST", f"{MODELS}/1/activate"),
        ("GET", f"{MODELS}/1/pictures/0.jpg"),
        ("GET", "/api/projects/nobody/models"),
    ):
        assert live.client.request(method, path).status_code == 404
    assert live.client.get(f"{MODELS}/{10**30}/pictures/0.jpg").status_code == 422
    assert live.client.get(f"{MODELS}/x/pictures/0.jpg").status_code == 422


def test_nothing_to_learn_from_is_told(live: Live) -> None:
    job = live.client.post(JOBS, json={"kind": "train"}).json()
    now = ended(live, job)
    assert now["state"] == "failed"
    assert "to learn from" in now["message"]
    propose = live.client.post(JOBS, json={"kind": "propose"}).json()
    assert "detector yet" in ended(live, propose)["message"]


@pytest.mark.slow
def test_train_propose_export(live: Live, generated: Path) -> None:
    """A training so short that nothing is learned: what it leaves behind is what counts here."""
    recording = open_recording(generated / "people")
    with open_project(live.settings.projects_root / "room") as project:
        for index, frame in enumerate(project.frames.of()[:2]):  # of one object in two frames come few pictures
            truth = load_truth(recording, index, recording.frame(index))[0]
            project.labels.create(frame.id, [NewLabel("person", truth.box)], Change(0, "a test", Source.MANUAL))
    assert live.client.get(MODELS).json()["material"] == {"image": 0, "view": 0, "labels": 2}
    wanted = {"kind": "train", "image_pictures": 4, "view_pictures": 20, "image_size_px": 64, "view_size_px": 64}
    with listen(live) as socket:
        job = live.client.post(JOBS, json=wanted).json()
        stages, curves, state = set(), 0, ""
        while state not in ("done", "failed"):
            told = next_of(socket, "job", 120)["job"]
            stages.add(told["stage"].split(",")[0])
            curves, state = max(curves, len(told["curves"])), told["state"]
    done = ended(live, job)
    assert done["state"] == "done", done["message"]
    assert {"train the image detector", "train the view detector"} <= stages
    assert curves >= 2

    models = live.client.get(MODELS).json()["models"]
    assert [(model["role"], model["active"]) for model in models] == [("image", True), ("view", True)]
    for model in models:
        assert model["boxes"] > 0
        assert model["curves"][0]["epoch"] == 1
        assert "box_loss" in model["curves"][0]["metrics"]
        assert model["pictures"]
        picture = live.client.get(model["pictures"][0])
        assert (picture.headers["content-type"], picture.content[:2]) == ("image/jpeg", b"\xff\xd8")
        assert live.client.get(model["pictures"][-1].replace("/0.", "/999.")).status_code in (200, 404)
    assert live.client.get("/api/projects/room").json()["detectors"]["view"]["id"] == models[1]["id"]
    assert live.client.post(f"{MODELS}/{models[0]['id']}/activate").json()["active"] is True

    live.client.post("/api/projects/room/recordings", json={"path": f"{generated.name}/hands", "labels": False})
    proposed = ended(live, live.client.post(JOBS, json={"kind": "propose", "recordings": [2], "limit": 2}).json())
    assert proposed["state"] == "done", proposed["message"]
    assert proposed["result"]["frames"] == 2
    unknown = ended(live, live.client.post(JOBS, json={"kind": "propose", "recordings": [77]}).json())
    assert "no recording with id 77" in unknown["message"]
