"""Errors sent to browsers name files, but not their folders on the server."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from annotator.web.errors import has_absolute_path, hide_paths
from annotator.workflows.add_recordings import add_recordings

if TYPE_CHECKING:
    from live_server import Live

PLACES = ((Path("/srv/data/inner"), "inner"), (Path("/srv/data"), "data"), (Path("/home/ada/my takes"), "takes"))


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("/srv/data/people/color/1.jpg: missing", "data/people/color/1.jpg: missing"),
        ("/srv/data/inner/x.txt:3: a word", "inner/x.txt:3: a word"),
        ("'/srv/data' and (/srv/data), see /srv/data.", "'data' and (data), see data."),
        ("/srv/data-2/x.png: broken", "…/x.png: broken"),
        ("/srv/database/x.png: broken", "…/x.png: broken"),
        ("/home/ada/my takes/a b/x.png: broken", "takes/a b/x.png: broken"),
        ("/home/bob/private/x.png: broken; give 1 m/s", "…/x.png: broken; give 1 m/s"),
        ("x.png: or/and 3 / 4, http://127.0.0.1:8080/a/b", "x.png: or/and 3 / 4, http://127.0.0.1:8080/a/b"),
        ("/secret: no such file", "…/secret: no such file"),
        ("color/1.jpg: missing", "color/1.jpg: missing"),
    ],
)
def test_messages_name_files_without_their_folders(message: str, shown: str) -> None:
    assert hide_paths(message, PLACES) == shown
    assert hide_paths(shown, PLACES) == shown


@given(st.lists(st.from_regex(r"[a-z0-9_.-]{1,8}", fullmatch=True), min_size=1, max_size=5), st.booleans())
def test_no_path_keeps_its_folders(parts: list[str], is_known: bool) -> None:
    parts = [part.strip(".-") or "x" for part in parts]
    path = Path("/srv/data" if is_known else "/var/lib", *parts)
    shown = hide_paths(f"{path}: broken", PLACES)
    assert not has_absolute_path(shown)
    assert path.name in shown and "/srv" not in shown and "/var" not in shown


def test_the_error_of_a_broken_frame_names_its_file_only(live: Live, generated: Path, tmp_path: Path) -> None:
    """For a recording in a registered folder, and for one elsewhere on the disk."""
    project = live.context.project("room")
    elsewhere = tmp_path / "elsewhere" / "own take"
    shutil.copytree(generated / "people", elsewhere)
    (added,) = add_recordings(project, [elsewhere], name="mine")
    frame = project.frames.of([added.recording.id])[1]
    (elsewhere / "color" / "000001.jpg").write_bytes(b"")
    answer = live.client.get(f"/api/projects/room/frames/{frame.id}")
    message = answer.json()["error"]["message"]
    assert (answer.status_code, message.partition(":")[0]) == (400, "mine/color/000001.jpg")
    assert str(tmp_path) not in message
    wrong = live.client.post("/api/projects/room/recordings", json={"path": generated.name}).json()
    assert wrong["error"]["message"].startswith(f"{generated.name}: no known recording format in this folder")
    assert str(generated.parent) not in wrong["error"]["message"]
