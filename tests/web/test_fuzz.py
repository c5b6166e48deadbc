"""Random requests that match the OpenAPI document never cause a server error."""

from __future__ import annotations

from itertools import count
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from live_server import running

from annotator.project import BoxRotation, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.web.jobs.records import WORK
from annotator.web.security import ServerSettings
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.recorded.own_labels import import_own_labels

EXAMPLES = 3
PATIENT = settings(
    max_examples=EXAMPLES,
    phases=[Phase.generate],
    suppress_health_check=list(HealthCheck),
)
# Random ids rarely exist; every second request uses existing ones.
REAL = {"project": "room", "name": "room", "frame": 1, "frame_id": 1, "model": 1, "number": 0}


@pytest.fixture
def fuzzed(tmp_path: Path, generated: Path) -> ServerSettings:
    """A server with a labelled project, which the requests may change."""
    upright = ProjectSettings(rotation=BoxRotation.UPRIGHT)
    with create_project(tmp_path / "projects", "room", ("person",), settings=upright) as project:
        import_own_labels(project, register_recording(project, open_recording(generated / "people")).id)
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


def test_no_request_causes_a_server_error(fuzzed: ServerSettings, monkeypatch: pytest.MonkeyPatch) -> None:
    for kind in WORK:
        monkeypatch.setitem(WORK, kind, "no.such.module:work")
    with running(fuzzed) as live:
        schema = schemathesis.openapi.from_dict(live.client.get("/api/openapi.json").json())
        operations = [found.ok() for found in schema.get_all_operations()]
        assert len(operations) > 20
        # last, since the others need the project and its recording
        operations.sort(key=lambda each: each.method.upper() == "DELETE" or each.path.endswith("/rename"))
        answers: dict[int, int] = {}
        faults: list[str] = []
        numbers = count()

        def ask(case: schemathesis.Case) -> None:
            if next(numbers) % 2:
                case.path_parameters.update({name: REAL[name] for name in case.path_parameters if name in REAL})
            headers = {"Origin": live.url, "Cookie": live.cookies()}
            case.headers.clear()
            case.cookies.clear()
            answer = case.call(base_url=live.url, headers=headers, timeout=300)
            answers[answer.status_code] = answers.get(answer.status_code, 0) + 1
            if answer.status_code >= 500:
                faults.append(f"{answer.status_code}: {case.as_curl_command()}")
            elif answer.status_code >= 400:
                assert set(answer.json()["error"]) == {"kind", "message"}, answer.text

        for operation in operations:
            PATIENT(given(case=operation.as_strategy())(ask))()
        assert live.client.get("/api/projects").status_code == 200, "the server still answers"
    assert not faults, "\n".join(faults[:20])
    assert answers.get(200, 0) > 20, answers
