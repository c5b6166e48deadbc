"""Models through the API; browser/test_scenario.py trains some."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

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


def test_detectors_are_loaded_at_once_when_the_page_asks(live: Live, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Path, bool]] = []
    detectors = live.context.caches.detectors
    monkeypatch.setattr(detectors, "warm", lambda project, at_once=False: asked.append((project.path, at_once)))
    assert live.client.post(f"{MODELS}/load").status_code == 204
    assert [(path.name, at_once) for path, at_once in asked] == [("room", True)]
