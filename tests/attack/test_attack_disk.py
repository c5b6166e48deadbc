"""A full disk: writes stop with a message, nothing half is offered, and nothing that was stored is lost."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from attacks import labels_in, require_sound
from live_server import running
from mortal import Mortal
from room_api import BOX, change, state

from annotator.web.security import ServerSettings

SIZE_KB = 3000


@pytest.fixture
def small(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MB; only root can mount one."""
    folder = tmp_path / "small"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_KB}k", "tmpfs", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip(f"a small disk needs the right to mount: {done.stderr.strip()}")
    yield folder
    # lazily: a failed test may still have files open
    subprocess.run(["umount", "-l", str(folder)], check=True)


def _fill(folder: Path) -> Path:
    """Fills a disk to the last byte; returns the file to remove."""
    file = folder / "filler"
    with file.open("wb", buffering=0) as stream:
        for size in (4096, 1):
            try:
                while True:
                    stream.write(b"\0" * size)
            except OSError:
                continue
    return file


def test_saves_on_a_full_disk_are_refused_and_lose_nothing(small: Path, empty: Path) -> None:
    shutil.copytree(empty, small, dirs_exist_ok=True)
    stored = 0
    with running(ServerSettings(small, port=0)) as live:
        create = {"kind": "create", "label": "person", "box": BOX}
        for _ in range(3):
            assert change(live.client, state(live.client)["frame"]["revision"], create).status_code == 200
            stored += 1
        filler = _fill(small)
        refusals = 0
        for _ in range(20):
            answer = change(live.client, state(live.client)["frame"]["revision"], *[create] * 20)
            if answer.status_code == 200:
                stored += 20
                continue
            refusals += 1
            assert "disk is full" in answer.json()["error"]["message"], answer.text
        assert refusals, "the disk was not full"
        assert len(state(live.client)["labels"]) == stored
        filler.unlink()
        assert change(live.client, state(live.client)["frame"]["revision"], create).status_code == 200
    require_sound(small / "room")
    assert len(labels_in(small / "room")["000000"]) == stored + 1


def test_commands_that_may_write_only_small_files_stop_with_a_message(
    mortal: Mortal, labelled: Path, tmp_path: Path
) -> None:
    """`ulimit -f`, for those who cannot mount a small disk: each file fails beyond a size."""
    before = labels_in(labelled / "room")
    copy = tmp_path / "copy"
    train = ["--only", "image", "--image-epochs", "1", "--image-size", "64", "--weights", "never"]
    for words in (
        ["train", "room", *train],
        ["annotate", "room", "--engine", "inline"],
        ["export", "room", str(tmp_path / "out")],
    ):
        for limit in (0, 4096, 65536, 400_000):
            shutil.rmtree(copy, ignore_errors=True)
            shutil.rmtree(tmp_path / "out", ignore_errors=True)
            shutil.copytree(labelled, copy)
            end = mortal.run(*words, "--projects", copy, file_limit=limit)
            assert end.code in (0, 1, 2), (words, limit, end)
            assert "Traceback" not in end.said, (words, limit, end.said[-1500:])
            require_sound(copy / "room")
            after = labels_in(copy / "room")
            # proposals may be added, reviewed boxes stay
            assert all(set(found) <= set(after[key]) for key, found in before.items())
            left = [path.name for path in tmp_path.iterdir() if "out" in path.name]
            assert left in ([], ["out"]), left
            assert end.code == 0 or not left, (words, limit)
