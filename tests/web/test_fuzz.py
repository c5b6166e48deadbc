"""Whatever is sent to the API, as its OpenAPI document describes it, no answer is a fault of the server."""

from __future__ import annotations

import time
from itertools import count
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from live_server import running

from annotator.project import BoxRotation, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.web.jobs.table import WORK
from annotator.web.settings import ServerSettings
from annotator.workflows.own_labels import import_own_labels
from annotator.workflows.recordings import register_recording

EXAMPLES = 12
WITHIN_S = 50.0
PATIENT = settings(
    max_examples=EXAMPLES,
    deadline=None,
    derandomize=True,
    database=None,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
# Most of what is made up names nothing that exists; every second request shall get further than that.
REAL = {"project": "room", "name": "room", "frame": 1, "frame_id": 1, "model": 1, "number": 0}


@pytest.fixture
def fuzzed(tmp_path: Path, generated: Path) -> ServerSettings:
    """A project with labels, one of whose frames may be changed in any way."""
    upright = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    with create_project(tmp_path / "projects", "room", ("person",), settings=upright) as project:
        import_own_labels(project, register_recording(project, open_recording(generated / "people")).id)
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


@pytest.mark.timeout(300)
def test_no_answer_is_a_fault_of_the_server(fuzzed: ServerSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in WORK:
        monkeypatch.setitem(WORK, kind, "no.such.module:work")
    with running(fuzzed) as live:
        schema = schemathesis.openapi.from_dict(live.client.get("/api/openapi.json").json())
        operations = [found.ok() for found in schema.get_all_operations()]
        assert len(operations) > 20
        answers: dict[int, int] = {}
        faults: list[str] = []
        numbers, end = count(), time.monotonic() + WITHIN_S

        def ask(case: schemathesis.Case) -> None:
            if time.monotonic() > end:
                return
            if next(numbers) % 2:
                case.path_parameters.update({name: REAL[name] for name in case.path_parameters if name in REAL})
            headers = {"Origin": live.url, "Cookie": live.cookies()}
            case.headers.clear()
            case.cookies.clear()
            answer = case.call(base_url=live.url, headers=headers, timeout=30)
            answers[answer.status_code] = answers.get(answer.status_code, 0) + 1
            if answer.status_code >= 500:
                faults.append(f"{answer.status_code}: {case.as_curl_command()}")
            elif answer.status_code >= 400:
                assert set(answer.json()["error"]) == {"kind", "message"}, answer.text

        for operation in operations:
            PATIENT(given(case=operation.as_strategy())(ask))()
        assert live.client.get("/api/projects/room").status_code == 200, "it still works"
    assert not faults, "\n".join(faults[:20])
    assert answers.get(200, 0) > 20, answers
