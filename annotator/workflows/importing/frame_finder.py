"""Finds the frames of a project that a dataset refers to."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from annotator.project import Project, StoredFrame
from annotator.text import normal


@dataclass(frozen=True)
class Renamed:
    """A dataset's recording that the project does not have, and the project's recordings that it was matched with."""

    named: str
    taken_for: tuple[str, ...]


class FrameFinder:
    """The frames of a project by recording and key.

    Keys such as 000012 occur in many recordings, so frames of another recording do not match. Exception: if the
    dataset has a single recording and the project has none of this name, it is matched with the project's recordings
    by key alone, and `renamed` reports it.

    Args:
        recording: name of the only recording to search; None = all.
        named: the recordings that the dataset names.

    Raises:
        NotFoundError: no such recording.
    """

    def __init__(self, project: Project, recording: str | None, named: Collection[str]) -> None:
        chosen = None if recording is None else [project.recordings.find(recording).id]
        self._names = {each.id: each.name for each in project.recordings.all()}
        self._by_key: dict[str, list[StoredFrame]] = {}
        self._by_place: dict[tuple[str, str], StoredFrame] = {}
        for frame in project.frames.of(chosen):
            self._by_key.setdefault(normal(frame.key), []).append(frame)
            self._by_place[self._names[frame.recording_id], normal(frame.key)] = frame
        existing = {place[0] for place in self._by_place}
        self._unknown = next(iter(named)) if len(set(named)) == 1 and not existing & set(named) else None

    def find(self, recording: str | None, key: str) -> list[StoredFrame]:
        """Returns the matching frames: more than one if several recordings have the key.

        Args:
            recording: the recording's name in the dataset; None if the dataset has no names.
        """
        if recording is None or recording == self._unknown:
            return self._by_key.get(normal(key), [])
        exact = self._by_place.get((recording, normal(key)))
        return [] if exact is None else [exact]

    def renamed(self, matched: Iterable[StoredFrame]) -> Renamed | None:
        """Returns the recordings that the dataset's recording was matched with, if the project has none of its name.

        Args:
            matched: the frames that were matched with it.
        """
        taken_for = tuple(dict.fromkeys(map(self.recording_of, matched)))
        return Renamed(self._unknown, taken_for) if self._unknown is not None and taken_for else None

    def recording_of(self, frame: StoredFrame) -> str:
        """Returns the name of a frame's recording."""
        return self._names[frame.recording_id]
