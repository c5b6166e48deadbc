"""Opened frames are read once, and the next one is read ahead."""

from __future__ import annotations

import pytest
from live_server import wait_until

from annotator.project import Project
from annotator.types import Frame
from annotator.types.errors import FrameError, NotFoundError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.workbench.frame_cache import FrameCache


@pytest.fixture
def project(people: Project) -> Project:
    return people


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of the frames that are read from the disk, in order."""
    found: list[str] = []
    read = FrameSource.read

    def counted(self: FrameSource, stored: object) -> Frame:
        found.append(vars(stored)["key"])
        return read(self, stored)  # type: ignore[arg-type]

    monkeypatch.setattr(FrameSource, "read", counted)
    return found


def _wait(reads: list[str], count: int) -> None:
    wait_until(lambda: len(reads) >= count)


def test_a_frame_is_read_once_and_the_next_ahead(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    first = cache.read(project, 1)
    assert cache.read(project, 1) is first
    _wait(reads, 2)
    assert reads == ["000000", "000001"]
    assert cache.read(project, 2).key == "000001"
    _wait(reads, 3)
    assert reads == ["000000", "000001", "000002"]
    cache.close()
    assert cache.read(project, 5).key == "000004", "after the end frames are still read, but not ahead"


def test_an_unreadable_frame_is_an_error_each_time(project: Project, reads: list[str]) -> None:
    cache = FrameCache()
    cache.close()
    project.recordings.rescan(1, ["000000", "gone"])
    gone = project.frames.find(1, "gone").id
    for _ in range(2):
        with pytest.raises(FrameError, match="frame gone no longer exists"):
            cache.read(project, gone)
    with pytest.raises(NotFoundError):
        cache.read(project, 99)
