"""Models through the API; browser/test_scenario.py trains some."""

from __future__ import annotations

from typing import TYPE_CHECKING

from test_web_jobs import JOBS, ended

if TYPE_CHECKING:
    from live_server import Live

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


def test_missing_training_data_is_reported(live: Live) -> None:
    job = live.client.post(JOBS, json={"kind": "train"}).json()
    now = ended(live, job)
    assert now["state"] == "failed"
    assert "to learn from" in now["message"]
    propose = live.client.post(JOBS, json={"kind": "propose"}).json()
    assert "detector yet" in ended(live, propose)["message"]
