"""Frames that cannot be read: told when a recording is added, left out on request, and back once they can be read."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from annotator.project import Project
from annotator.recordings import open_recording
from annotator.types.errors import RecordingError
from annotator.workflows import add_recordings as adding
from annotator.workflows.add_recordings import add_recordings, bring_back, move_recording
from annotator.workflows.importing import Note
from annotator.workflows.recorded.condition import broken_frames
from annotator.workflows.recorded.own_labels import import_own_labels

BROKEN = ["000001", "000003", "000004"]
ALWAYS = float("inf")


@pytest.fixture(autouse=True)
def read_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """All frames are read, also on a slow machine."""
    monkeypatch.setattr(adding, "SECONDS", ALWAYS)


@pytest.fixture
def damaged(own_copy: Callable[[str], Path]) -> Path:
    """A recording of five frames: one without depth, one with an empty file, one with a truncated image."""
    folder = own_copy("people")
    (folder / "depth" / "000001.png").unlink()
    (folder / "depth" / "000003.png").write_bytes(b"")
    image = folder / "color" / "000004.jpg"
    image.write_bytes(image.read_bytes()[:-200])
    return folder


def mend(folder: Path, generated: Path, *names: str) -> None:
    for name in names:
        shutil.copy(generated / "people" / name, folder / name)


def present(project: Project) -> dict[str, int]:
    """The indices of the frames that queues, batches and exports see, by key."""
    return {frame.key: frame.index for frame in project.frames.of() if frame.index is not None}


def test_each_kind_of_fault_is_counted(damaged: Path) -> None:
    (damaged / "depth" / "000000.png").unlink()
    broken = broken_frames(open_recording(damaged), seconds=ALWAYS)
    assert list(broken.errors) == ["000000", *BROKEN]
    first, *kinds = broken.sentences
    assert first == "4 of 5 frames cannot be read"
    assert [line.partition(";")[0] for line in kinds] == [
        f"2 frames (000000, 000001): {damaged}/depth/000000.png: missing",
        f"1 frame (000003): {damaged}/depth/000003.png: the file is empty",
        f"1 frame (000004): {damaged}/color/000004.jpg: the JPEG image is truncated",
    ]


def test_without_time_only_files_are_looked_at(damaged: Path, generated: Path) -> None:
    broken = broken_frames(open_recording(damaged), seconds=-1)
    assert list(broken.errors) == BROKEN[:2]
    assert broken.unread == 3
    assert broken.sentences[0] == "2 of 5 frames cannot be read (of 3, at most the files were looked at)"
    assert list(broken_frames(open_recording(damaged), {"000004"}, seconds=-1).errors) == BROKEN
    assert broken_frames(open_recording(generated / "people"), seconds=ALWAYS).sentences == ()


def test_broken_frames_are_told_and_left_out_on_request(
    make_project: Callable[..., Project], damaged: Path, generated: Path
) -> None:
    project = make_project()
    (added,) = add_recordings(project, [damaged])
    assert (list(added.broken.errors), added.left_out, added.recording.frames) == (BROKEN, 0, 5)
    assert present(project) == {f"00000{i}": i for i in range(5)}
    (again,) = add_recordings(project, [damaged], leave_out_broken=True)
    assert (again.left_out, again.new_frames, again.recording.frames) == (3, 0, 2)
    assert present(project) == {"000000": 0, "000002": 2}
    imported = import_own_labels(project, added.recording.id)
    assert (imported.boxes, list(imported.of(Note.UNREADABLE))) == ({"person": 6}, [])
    # a frame that is still broken stays out, and one that can be read comes back
    mend(damaged, generated, "depth/000003.png")
    (mended,) = add_recordings(project, [damaged])
    assert (mended.left_out, list(mended.broken.errors)) == (2, ["000001", "000004"])
    assert present(project) == {"000000": 0, "000002": 2, "000003": 3}


def test_a_new_recording_without_its_broken_frames(
    make_project: Callable[..., Project], damaged: Path, generated: Path, tmp_path: Path
) -> None:
    project = make_project()
    (added,) = add_recordings(project, [damaged], leave_out_broken=True)
    assert (added.left_out, added.new_frames, added.recording.frames) == (3, 2, 2)
    assert present(project) == {"000000": 0, "000002": 2}
    # a moved folder keeps what was left out, as far as it is still broken
    moved = Path(shutil.move(damaged, tmp_path / "moved"))
    mend(moved, generated, "color/000004.jpg")
    move_recording(project, added.recording.id, moved, "ada")
    assert present(project) == {"000000": 0, "000002": 2, "000004": 4}
    # a recording that was removed comes back whole
    project.recordings.remove(added.recording.id, "ada")
    bring_back(project, added.recording.id)
    assert present(project) == {f"00000{i}": i for i in range(5)}


def test_frames_are_left_out_even_if_the_first_ones_are_broken(
    make_project: Callable[..., Project], own_copy: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(adding, "FRAMES_TRIED", 4)
    project, folder = make_project(), own_copy("people")
    for number in range(4):
        (folder / "depth" / f"00000{number}.png").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"first frames can be read \(4 tried; --leave-out-broken tries all\)"):
        add_recordings(project, [folder])
    add_recordings(project, [folder], leave_out_broken=True)
    assert present(project) == {"000004": 4}
    # from then on, the recording is known by the others
    (again,) = add_recordings(project, [folder])
    assert (again.left_out, again.missing_frames) == (4, 0)
    (folder / "depth" / "000004.png").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"none of its first frames can be read \(5 tried\)"):
        add_recordings(project, [folder], leave_out_broken=True)
