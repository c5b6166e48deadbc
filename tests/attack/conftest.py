"""Attacks on a server and on stored work; run by `scripts/attack`, not by `scripts/test`. They use loopback only."""

from __future__ import annotations

import ipaddress
import random
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from live_server import Live, running

from annotator.project import create_project
from annotator.recordings import open_recording
from annotator.web.settings import ServerSettings
from annotator.workflows.add_recordings import register_recording

HERE = Path(__file__).parent


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("attack", "options of scripts/attack")
    group.addoption("--attack-seed", type=int, default=0, help="seed of random moments and inputs")
    group.addoption("--attack-times", type=int, default=20, help="kills of each command")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks every test of this folder, so that none can get into `scripts/test` by oversight."""
    for item in items:
        if HERE in item.path.parents:
            item.add_marker("attack")


@pytest.fixture(autouse=True)
def _loopback_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """A connection to another machine is an error."""
    connect = socket.socket.connect

    def checked(self: socket.socket, address: Any) -> None:
        if self.family in (socket.AF_INET, socket.AF_INET6) and address[0] != "localhost":
            assert ipaddress.ip_address(address[0]).is_loopback, f"an attack on another machine: {address}"
        connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", checked)


@pytest.fixture
def chance(request: pytest.FixtureRequest) -> random.Random:
    """Random numbers of this test, from the seed of `scripts/attack`."""
    return random.Random(f"{request.config.getoption('attack_seed')} {request.node.nodeid}")


@pytest.fixture
def times(request: pytest.FixtureRequest) -> int:
    """How often each command is killed."""
    count: int = request.config.getoption("attack_times")
    return count


@pytest.fixture
def web_settings(tmp_path: Path, generated: Path) -> ServerSettings:
    """Settings of a server with the project `room` of 5 unlabelled frames of people, and the folder `generated`."""
    with create_project(tmp_path / "projects", "room", ("person",)) as project:
        register_recording(project, open_recording(generated / "people"))
    return ServerSettings(tmp_path / "projects", (generated,), port=0)


@pytest.fixture
def live(web_settings: ServerSettings) -> Iterator[Live]:
    """A server for one test, with the project `room`; its client has signed in."""
    with running(web_settings) as server:
        yield server
