"""The API of Alignment mode: the cloud over the image, its correction, and the up direction."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
from room_api import ROOM, state
from scipy.spatial import cKDTree
from test_events import listen, next_of

from annotator.project import Project, open_project
from annotator.recordings import open_recording
from annotator.types import Correction

if TYPE_CHECKING:
    from live_server import Live

RECORDING = f"{ROOM}/recordings/1"
TURNED = {"turn_deg": [0.5, -2.0, 1.0], "shift_m": [0.03, 0.0, -0.1], "time_offset_s": 0.0}
NONE = {"turn_deg": [0.0, 0.0, 0.0], "shift_m": [0.0, 0.0, 0.0], "time_offset_s": 0.0}


@pytest.fixture
def project(live: Live) -> Project:
    return live.context.project("room")


def shown(client: httpx.Client, frame: int = 1) -> dict[str, Any]:
    answer = client.get(f"{ROOM}/frames/{frame}/alignment")
    assert answer.status_code == 200, answer.text
    content: dict[str, Any] = answer.json()
    return content


def correct(client: httpx.Client, correction: dict[str, Any], frame: int = 1, **more: Any) -> httpx.Response:
    body = {"correction": correction, "frame": frame, "adjusted": shown(client)["adjusted"], **more}
    return client.post(f"{RECORDING}/correction", json=body)


def test_the_points_are_those_of_the_files_whatever_the_correction(live: Live, generated: Path) -> None:
    before = shown(live.client)
    recorded = open_recording(generated / "people").frame(0)
    points = np.array(before["points"]).reshape(-1, 3)
    assert 1000 < len(points) <= 15_000
    assert before["correction"] == NONE and not before["is_virtual"]
    distance, _ = cKDTree(recorded.cloud.xyz_m).query(points)
    assert distance.max() < 1e-3
    after = correct(live.client, TURNED).json()
    assert after["points"] == before["points"]
    assert after["correction"]["turn_deg"] == pytest.approx(TURNED["turn_deg"])
    assert after["adjusted"] > before["adjusted"]


def test_a_correction_of_an_outdated_one_is_refused(live: Live) -> None:
    seen = shown(live.client)["adjusted"]
    assert correct(live.client, TURNED, adjusted=seen).status_code == 200
    assert correct(live.client, NONE, adjusted=seen).status_code == 409
    body = {"up": [0.0, -1.0, 0.0], "frame": 1, "adjusted": seen}
    assert live.client.post(f"{RECORDING}/up", json=body).status_code == 409


def test_up_is_estimated_set_and_cleared(live: Live) -> None:
    known = state(live.client)["up"]
    found = live.client.post(f"{RECORDING}/estimate-up", json={}).json()
    assert np.degrees(np.arccos(np.dot(found["up"], known))) < 2
    assert found["certainty"] > 0.6
    assert live.client.post(f"{ROOM}/recordings/99/estimate-up", json={}).status_code == 404
    body = {"up": [0.1, -0.99, 0.0], "frame": 1, "adjusted": shown(live.client)["adjusted"]}
    answer = live.client.post(f"{RECORDING}/up", json=body).json()
    assert answer["up_source"] == "project"
    assert state(live.client, 2)["up"] == pytest.approx(answer["up"])
    cleared = live.client.post(f"{RECORDING}/up", json={**body, "up": None, "adjusted": answer["adjusted"]}).json()
    assert (cleared["up_source"], cleared["up"]) == ("files", known)


def test_pages_hear_of_adjustments_by_others_and_by_the_command_line(live: Live) -> None:
    with listen(live) as socket, open_project(live.settings.projects_root / "room") as outside:
        next_of(socket, "presence")
        correct(live.client, TURNED)
        event = next_of(socket, "adjusted")
        assert (event["recording"], event["operator"]) == (1, "Ada")
        outside.adjustments.correct(1, Correction(), "annotator calibrate")
        assert next_of(socket, "adjusted")["operator"] == "annotator calibrate"
    assert shown(live.client)["correction"] == NONE


def test_wrong_corrections_are_refused(live: Live) -> None:
    # frames without times have no offset
    wrong = ({"turn_deg": [0.0, 181.0, 0.0]}, {"time_offset_s": 1e9}, {"other": 1}, {"time_offset_s": 0.1})
    for part in wrong:
        assert correct(live.client, {**NONE, **part}).status_code in (400, 422)
    unknown = correct(live.client, TURNED, frame=999)
    assert unknown.status_code == 400 and "no such frame" in unknown.json()["error"]["message"]
    assert shown(live.client)["correction"] == NONE


def test_a_large_correction_of_the_command_line_can_be_changed(live: Live, project: Project) -> None:
    project.adjustments.correct(1, Correction((0.0, 2.5, 0.0), (0.0, 0.0, 200.0)), "Ann")
    stored = shown(live.client)["correction"]
    answer = correct(live.client, {**stored, "turn_deg": [1.0, *stored["turn_deg"][1:]]})
    assert answer.status_code == 200, answer.text
