"""Files of a recording or a project that never end, or that are far larger than they look."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:
    from live_server import Live


ENDLESS: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "random": lambda path: path.symlink_to("/dev/urandom"),
    "sparse": lambda path: path.touch() or os.truncate(path, 700 << 20),  # type: ignore[func-returns-value]
}


def peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.parametrize("kind", ENDLESS)
def test_an_endless_file_of_a_project_is_refused(live: Live, tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "projects" / "odd"
    folder.mkdir()
    ENDLESS[kind](folder / "project.json")
    before = peak_mib()
    listed = live.client.get("/api/projects", timeout=30).json()
    assert "odd" in str(listed) and "room" in str(listed)
    assert live.client.get("/api/projects/odd", timeout=30).status_code >= 400
    assert live.client.get("/api/projects/room", timeout=30).status_code == 200
    assert peak_mib() - before < 200


@pytest.mark.parametrize("kind", ENDLESS)
def test_an_endless_file_of_a_recording_is_refused(live: Live, own_copy: Callable[[str], Path], kind: str) -> None:
    from annotator.recordings import open_recording
    from annotator.workflows.add_recordings import register_recording

    recording = own_copy("people")
    project = live.context.project("room")
    registered = register_recording(project, open_recording(recording))
    first = project.frames.of([registered.id])[0]
    camera = recording / "camera_intrinsic.json"
    camera.unlink()
    ENDLESS[kind](camera)
    before = peak_mib()
    assert live.client.get(f"/api/projects/room/frames/{first.id}", timeout=30).status_code >= 400
    assert live.client.get("/api/projects", timeout=30).status_code == 200
    assert peak_mib() - before < 200


def test_a_small_archive_of_a_gigabyte_is_refused(live: Live, tmp_path: Path) -> None:
    from annotator.recordings import open_recording
    from annotator.workflows.add_recordings import register_recording

    clouds = tmp_path / "clouds"
    clouds.mkdir()
    np.savez_compressed(clouds / "0.npz", points=np.zeros((20_000_000, 3), np.float32))
    project = live.context.project("room")
    registered = register_recording(project, open_recording(clouds))
    first = project.frames.of([registered.id])[0]
    before = peak_mib()
    answer = live.client.get(f"/api/projects/room/frames/{first.id}", timeout=60)
    assert answer.status_code >= 400
    assert "ANNOTATOR_FRAME_MEMORY" in answer.text
    assert peak_mib() - before < 200
