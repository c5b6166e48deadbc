"""Attacks on a server and on stored work; run by `scripts/attack`, not by `scripts/test`. They use loopback only."""

from __future__ import annotations

import ipaddress
import random
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from attacks import Killer
from mortal import Mortal
from room_server import own_live, projects_with_room, web_settings

from annotator.cli.main import main

__all__ = ["live", "own_live", "projects_with_room", "web_settings"]

live = own_live

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


@pytest.fixture(scope="module")
def mortal(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mortal]:
    """Runs commands and kills them."""
    runner = Mortal(generated / "people", tmp_path_factory.mktemp("mortal") / "log")
    yield runner
    runner.close()


def _room(root: Path, recording: Path, *more: list[str]) -> Path:
    adds = ["add", "room", str(recording)]
    for words in (["new", "room", "--classes", "person"], adds if more else [*adds, "--no-labels"], *more):
        assert main([*words, "--projects", str(root)]) == 0
    return root


@pytest.fixture(scope="module")
def labelled(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `room`: 5 frames with 3D labels and 2D boxes; do not change it."""
    return _room(tmp_path_factory.mktemp("labelled"), generated / "people", ["import", "room", "--as", "2d"])


@pytest.fixture(scope="module")
def empty(generated: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `room`: 5 frames without labels; do not change it."""
    return _room(tmp_path_factory.mktemp("empty"), generated / "people")


@pytest.fixture
def killer(mortal: Mortal, tmp_path: Path, times: int, chance: random.Random) -> Callable[[Path], Killer]:
    """`killer(template)`: kills commands that work on copies of a folder, at `tmp_path / "copy"`."""
    return lambda template: Killer(mortal, template, tmp_path / "copy", times, chance)
