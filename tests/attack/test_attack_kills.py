"""`kill -9` of the commands that write, and full disks: nothing acknowledged is lost, nothing half is offered."""

from __future__ import annotations

import io
import random
import shutil
import subprocess
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import httpx
import numpy as np
import pytest
from attacks import Killer, Labels, content_of, labels_in, require_sound
from live_server import PATIENCE_S, running, wait_until
from mortal import Mortal
from room_api import BOX, change, state
from store_samples import damage
from test_server_process import EDITS_BEFORE_KILL, Editor, server

from annotator.cli.main import main
from annotator.project import FramePart, Project, WriteContext, create_project, open_project
from annotator.project.backup.archive import read_manifest
from annotator.project.changes import NewLabel
from annotator.types import BoxKind, OrientedBox, Source
from annotator.web.security import ServerSettings

# 20 kills of a training, on a busy machine
pytestmark = pytest.mark.timeout(3600)


def require_whole_frames(kills: Killer, words: Sequence[str | Path], wanted: Labels) -> None:
    """Each kill of the command leaves whole frames of the wanted labels, and the next run makes the others."""
    room = kills.folder / "room"
    for end in kills.kills(*words):
        require_sound(room)
        for key, labels in labels_in(room).items():
            assert labels in ([], wanted[key]), f"half a frame {key}: {labels}"
        assert end.was_killed or labels_in(room) == wanted
        kills.whole(*words)
        assert labels_in(room) == wanted


def test_a_killed_annotate_stores_whole_frames_and_goes_on(killer: Callable[[Path], Killer], empty: Path) -> None:
    kills = killer(empty)
    words = ["annotate", "room", "--projects", kills.folder, "--engine", "inline"]
    kills.fresh()
    kills.whole(*words)
    wanted = labels_in(kills.folder / "room")
    assert all(wanted.values())
    require_whole_frames(kills, words, wanted)


def test_a_killed_training_offers_no_half_detector(killer: Callable[[Path], Killer], labelled: Path) -> None:
    kills = killer(labelled)
    words = ["train", "room", "--projects", kills.folder, "--only", "image", "--image-epochs", "1"]
    words += ["--image-size", "64", "--weights", "never"]
    room = kills.folder / "room"
    before = labels_in(labelled / "room")
    for end in kills.kills(*words):
        require_sound(room)
        assert labels_in(room) == before
        with open_project(room) as project:
            assert len(project.models.all()) <= 1
            assert end.was_killed or project.models.all()
    kills.whole(*words)
    require_sound(room)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_killed_export_leaves_a_whole_dataset_or_none(
    killer: Callable[[Path], Killer], labelled: Path, tmp_path: Path, overwrite: bool
) -> None:
    kills = killer(labelled)
    out = tmp_path / "datasets" / "people"
    words = ["export", "room", out, "--projects", kills.folder, "--format", "kitti"]
    old = tmp_path / "old"
    kills.fresh()
    kills.whole(*words)
    shutil.copytree(out, old)
    next((old / "training" / "label_2").iterdir()).write_text("")
    wanted, before = content_of(out), content_of(old)
    words += ["--overwrite"]
    for end in kills.kills(*words):
        require_sound(kills.folder / "room")
        found = content_of(out) if out.exists() else None
        # between the two renames of --overwrite there is none; the next export then puts the old one back, or its own
        assert found in (None, before, wanted), sorted(found or ())
        assert end.was_killed or found == wanted
        kills.whole(*words)
        assert content_of(out) == wanted
        assert [path.name for path in out.parent.iterdir()] == ["people"], "a leftover"
        shutil.rmtree(out)
        if overwrite:
            shutil.copytree(old, out)


def test_a_killed_import_stores_whole_frames_and_goes_on(
    killer: Callable[[Path], Killer], empty: Path, labelled: Path, tmp_path: Path
) -> None:
    kills = killer(empty)
    wanted = labels_in(labelled / "room")
    kills.whole("export", "room", tmp_path / "labels", "--projects", labelled, "--format", "openlabel")
    words = ["import", "room", tmp_path / "labels", "--format", "openlabel", "--projects", kills.folder]
    require_whole_frames(kills, words, wanted)


LABELS = 900


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A projects folder with `long`, a project of many labels and views; do not change it."""
    root = tmp_path_factory.mktemp("long")
    with create_project(root, "long", ("person",)) as project:
        fill(project, 300, LABELS, 100)
    return root


def test_a_killed_backup_is_whole_or_not_there(killer: Callable[[Path], Killer], long: Path, tmp_path: Path) -> None:
    kills = killer(long)
    file = tmp_path / "backups/long.zip"
    file.parent.mkdir()
    words = ["project", "backup", "long", file, "--projects", kills.folder]
    wanted = labels_in(long / "long")
    restored = 0
    for number, end in enumerate(kills.kills(*words, done=file.unlink)):
        require_sound(kills.folder / "long")
        assert end.was_killed or file.exists()
        if not file.exists():
            # the next backup is not in the way of what is left, and removes it
            kills.whole(*words)
        root = tmp_path / f"restored{number}"
        assert main(["project", "restore", str(file), "--projects", str(root)]) == 0
        require_sound(root / "long")
        assert labels_in(root / "long") == wanted
        restored += 1
        if len(list(file.parent.iterdir())) > 1:  # killed when the file was complete
            file.unlink()
            kills.whole(*words)
        assert [path.name for path in file.parent.iterdir()] == ["long.zip"], "a leftover"
        file.unlink()
    assert restored == kills.times


def test_a_killed_restore_makes_a_whole_project_or_none(
    killer: Callable[[Path], Killer], long: Path, tmp_path: Path
) -> None:
    file = tmp_path / "long.zip"
    assert main(["project", "backup", "long", str(file), "--projects", str(long)]) == 0
    kills = killer(long)
    words = ["project", "restore", file, "again", "--projects", kills.folder]
    again, wanted = kills.folder / "again", labels_in(long / "long")
    for end in kills.kills(*words):
        require_sound(kills.folder / "long")
        assert end.was_killed or again.exists()
        shown = kills.whole("stats", "long", "--projects", kills.folder)
        assert shown.code == 0
        if not again.exists():
            kills.whole(*words)
        require_sound(again)
        assert labels_in(again) == wanted
        assert sorted(path.name for path in kills.folder.iterdir()) == ["again", "long"], "a leftover"


COMMANDS: dict[str, tuple[list[str], Callable[[Path], None] | None]] = {
    "copy": (["project", "copy", "{folder}/long", "new"], None),
    "repair": (["project", "repair", "long", "new"], damage("DROP TRIGGER events_are_not_deleted")),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_kill_leaves_nothing_half(killer: Callable[[Path], Killer], long: Path, tmp_path: Path, name: str) -> None:
    words, change = COMMANDS[name]
    template = Path(shutil.copytree(long, tmp_path / "template"))
    if change is not None:
        change(template / "long")
    kills = killer(template)
    words = [word.format(folder=kills.folder) for word in words]
    for _ in kills.kills(*words, "--projects", kills.folder):
        offered = {path.name for path in kills.folder.iterdir() if not path.name.startswith(".")}
        assert offered <= {"long", "new"}
        # what is repaired stays as it was
        for each in offered - ({"long"} if name == "repair" else set()):
            with open_project(kills.folder / each) as project:
                assert project.statistics().labels.total == LABELS
            require_sound(kills.folder / each)
        for backup in (kills.folder / ".backups" / "long").glob("*.zip"):
            assert read_manifest(backup).labels == LABELS


EDITORS = 2
LONGEST_S = 6.0


def test_a_killed_server_loses_no_acknowledged_save_and_offers_no_half_export(
    web_settings: ServerSettings, times: int, chance: random.Random
) -> None:
    room = web_settings.projects_root / "room"
    for number in range(times):
        with server(web_settings.projects_root) as (url, process):
            _require_whole_downloads(url)
            editors = [
                Editor(url, 1 + (number + other) % 5, 100 * number + other, f"ann {number} {other}")
                for other in range(EDITORS)
            ]
            threads = [threading.Thread(target=editor.run) for editor in editors]
            for thread in threads:
                thread.start()
            wait_until(lambda editors=editors: all(each.acknowledged > EDITS_BEFORE_KILL for each in editors))  # type: ignore[misc]
            headers = {"Origin": url}
            with httpx.Client(base_url=url, headers=headers, timeout=PATIENCE_S) as client:
                client.post("/api/session", json={"operator": "ann"})
                job = client.post("/api/projects/room/jobs", json={"kind": "export", "format": "kitti"})
                assert job.status_code == 201, job.text
            time.sleep(chance.uniform(0.0, LONGEST_S))
            process.kill()
            process.wait()
            for thread in threads:
                thread.join(PATIENCE_S)
        require_sound(room)
        with open_project(room) as project:
            for editor in editors:
                editor.require_kept(project)


def _require_whole_downloads(url: str) -> None:
    """Every job of the last server has ended, and what it offers can be downloaded as a whole."""
    with httpx.Client(base_url=url, headers={"Origin": url}, timeout=PATIENCE_S) as client:
        client.post("/api/session", json={"operator": "ann"})
        for job in client.get("/api/jobs").json():
            assert job["state"] not in ("queued", "running"), job
            if job["state"] == "done":
                file = client.get(f"/api/jobs/{job['id']}/download")
                assert file.status_code in (200, 404), file.text
                if file.status_code == 200:
                    assert file.content[:2] == b"PK"
                    _require_zip(file.content)


def _require_zip(content: bytes) -> None:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist()


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


def fill(project: Project, frames: int, labels: int, views: int) -> None:
    """Adds one recording with reviewed labels, and pseudo-views with boxes."""
    keys = [f"{n:06d}" for n in range(frames)]
    recording = project.recordings.add(project.path.parent / "recording", "rgbd", "long", keys, True)
    stored = project.frames.of([recording.id])
    shares = [labels * (n + 1) // frames - labels * n // frames for n in range(frames)]
    parts = [
        FramePart(frame.id, [_label(n, k) for k in range(share)], WriteContext(0, "Ada", Source.MANUAL))
        for n, (frame, share) in enumerate(zip(stored, shares, strict=True))
        if share
    ]
    for first in range(0, len(parts), 500):
        project.log.append_to_frames(parts[first : first + 500])
    rng = np.random.default_rng(0)
    for _ in range(views):
        picture = rng.integers(0, 255, (60, 60, 3), np.uint8)
        project.boxes.set_on_view(project.views.store(picture), [], BoxKind.BOX, WriteContext(0, "Ada", Source.MANUAL))


def _label(frame: int, number: int) -> NewLabel:
    box = OrientedBox.from_parts(np.array([2.0 * number, 0.1, 3.0]), np.eye(3), np.array([1.0, 0.7, 0.4]))
    return NewLabel("person", box, uid=f"{frame}-{number}")
