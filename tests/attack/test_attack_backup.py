"""`kill -9` of backup, restore, repair, copy and upgrade at random moments: nothing half offered, nothing lost."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest

from annotator.project import create_project, open_project
from annotator.project.backup.archive import read_manifest
from annotator.project.backup.make import back_up
from annotator.project.backup.take_in import restore
from annotator.project.backup.verify import verify
from benchmarks.backup import fill

pytestmark = pytest.mark.attack

ROOT = Path(__file__).resolve().parents[2]
KILLS = 20  # of each command, unless `--attack-times` says otherwise


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the project `long` and its backup `long.zip`."""
    root = tmp_path_factory.mktemp("backup")
    with create_project(root, "long", ("person",)) as project:
        fill(project, 300, 900, 100)
    back_up(root / "long", root / "long.zip")
    return root


def upgrade(root: Path) -> None:
    """Makes the project's database one of the version before."""
    with closing(sqlite3.connect(root / "long" / "project.db", isolation_level=None)) as connection:
        connection.execute("DROP TABLE generation")
        connection.execute("PRAGMA user_version = 14")


def damage(root: Path) -> None:
    with closing(sqlite3.connect(root / "long" / "project.db", isolation_level=None)) as connection:
        connection.execute("DROP TRIGGER events_are_not_deleted")


COMMANDS = {
    "backup": (["project", "backup", "long", "new.zip"], None),
    "restore": (["project", "restore", "long.zip", "new"], None),
    "copy": (["project", "copy", "long", "new"], None),
    "repair": (["project", "repair", "long"], None),
    "salvage": (["project", "repair", "long", "new"], damage),
    "upgrade": (["stats", "long"], upgrade),
}


def run(words: list[str], root: Path, kill_after_s: float | None) -> float:
    """Runs a command; returns how long it ran."""
    begin = time.perf_counter()
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "annotator", *words, "--projects", str(root)]
    process = subprocess.Popen(
        command, cwd=root, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    with process, suppress(subprocess.TimeoutExpired):
        try:
            _, errors = process.communicate(timeout=kill_after_s)
            assert process.returncode == 0, errors
        finally:
            process.kill()
    return time.perf_counter() - begin


@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_leaves_nothing_half(name: str, place: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    moments = random.Random(name)
    words, prepare = COMMANDS[name]
    whole_s = None
    for number in range(request.config.getoption("attack_times", KILLS) + 1):
        root = Path(shutil.copytree(place, tmp_path / str(number)))
        if prepare is not None:
            prepare(root)
        duration = run(words, root, None if whole_s is None else moments.uniform(0.3, 1.0) * whole_s)
        whole_s = whole_s or duration
        offered = sorted(path.name for path in root.iterdir() if not path.name.startswith("."))
        assert set(offered) <= {"long", "long.zip", "recording", "new", "new.zip"}
        if "new.zip" in offered:
            assert read_manifest(root / "new.zip").labels == 900
            restore(root / "new.zip", root, "new")
        for each in ("new", "long"):
            if (root / each).exists() and not (each == "long" and prepare is damage):
                with open_project(root / each) as project:
                    assert project.statistics().labels.total == 900
                assert verify(root / each, deep=number % 5 == 0).problems == ()
        for backup in (root / ".backups" / "long").glob("*.zip"):
            assert read_manifest(backup).labels == 900
        shutil.rmtree(root)
