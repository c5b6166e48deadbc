"""Which frame of a project a dataset means."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

from annotator.project import Project, StoredFrame


@dataclass(frozen=True)
class Renamed:
    """A recording that a dataset names and the project does not have, and the project's that it was taken for."""

    named: str
    taken_for: tuple[str, ...]


class FrameFinder:
    """The frames of a project by recording and key.

    Keys such as 000012 are everywhere: what a dataset says of another recording is about none of the project's frames.
    Only where it names a single recording, and one that the project does not have, is that taken for the project's
    recording under another name; `renamed` tells so.

    Args:
        recording: name of the only recording to look in; None = all.
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
            self._by_key.setdefault(frame.key, []).append(frame)
            self._by_place[self._names[frame.recording_id], frame.key] = frame
        known = {place[0] for place in self._by_place}
        self._unknown = next(iter(named)) if len(set(named)) == 1 and not known & set(named) else None

    def find(self, recording: str | None, key: str) -> list[StoredFrame]:
        """The frames that may be meant: more than one where several recordings have the key.

        Args:
            recording: as the dataset names it; None where it does not.
        """
        if recording is None or recording == self._unknown:
            return self._by_key.get(key, [])
        exact = self._by_place.get((recording, key))
        return [] if exact is None else [exact]

    def renamed(self, found: Iterable[StoredFrame]) -> Renamed | None:
        """What the dataset's recording was taken for, where the project has none of its name.

        Args:
            found: the frames that were found for it.
        """
        taken_for = tuple(dict.fromkeys(map(self.recording_of, found)))
        return Renamed(self._unknown, taken_for) if self._unknown is not None and taken_for else None

    def recording_of(self, frame: StoredFrame) -> str:
        """The name of a frame's recording."""
        return self._names[frame.recording_id]
