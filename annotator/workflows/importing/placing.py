"""The project's frames and classes of a dataset's names."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from annotator.file_names import normal
from annotator.project import Project, StoredFrame
from annotator.types.errors import ConfigError, FormatError
from annotator.types.names import alternatives, folded, nearest

NO_NAMES: Mapping[str, str] = MappingProxyType({})


def renamed_class(label: str, names: Mapping[str, str]) -> str:
    """Returns the project's class of a dataset's class; classes that are not listed keep their names."""
    return names.get(label, label)


def class_names(text: str, project: Project) -> dict[str, str]:
    """Parses `Car=car,Pedestrian=person`: classes of a file, and the project's classes that they become.

    Raises:
        ConfigError: another form, a class that is there twice, or one that the project does not have.
    """
    names: dict[str, str] = {}
    for part in text.split(","):
        theirs, equals, ours = (word.strip() for word in part.rpartition("="))
        if not (equals and theirs and ours):
            raise ConfigError(f"--classes {text}: write CLASS_OF_THE_FILE=CLASS_OF_THE_PROJECT, separated by commas")
        if theirs in names:
            raise ConfigError(f"--classes {text}: {theirs} is there twice; keep one")
        if ours not in project.config.classes:
            others = alternatives(ours, project.config.classes)
            raise ConfigError(f"--classes {text}: the project has no class {ours!r}; {others}")
        names[theirs] = ours
    return names


def how_to_map(theirs: Collection[str], project: Project) -> str:
    """For messages: what to do about a dataset of which the project has no class."""
    ours = project.config.classes
    pairs = ((label, nearest(label, ours)) for label in sorted(theirs))
    label, near = next((pair for pair in pairs if pair[1] is not None), (min(theirs), None))
    meant = "" if near is None else f"did you mean {near!r}? "
    return (
        f"{meant}Map the classes to those of the project, as in --classes {label}={near or ours[0]}, or add them with "
        "`annotator classes add`"
    )


def without_effect(names: Mapping[str, str], present: Collection[str]) -> list[str]:
    """Returns a line for each class in `names` that a dataset does not have.

    Args:
        names: as `class_names` returns them.
        present: classes of the dataset's boxes.

    Raises:
        ConfigError: the dataset has such a class in another spelling only, which `names` does not have.
    """
    lines = []
    others = set(present) - names.keys()
    for theirs, ours in names.items():
        if theirs in present or not present:
            continue
        near = nearest(theirs, sorted(others))
        missing = f"the dataset has no class {theirs!r}" + ("" if near is None else f"; did you mean {near!r}?")
        if near is not None and folded(near) == folded(theirs):
            raise ConfigError(f"--classes {theirs}={ours}: {missing}")
        lines.append(f"--classes {theirs}={ours} has no effect: {missing}")
    return lines


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


AUTHOR = "import"


@dataclass(frozen=True)
class Importer:
    """Who imports.

    Attributes:
        action: id of the action (`project.new_action`) that undoes the whole import; None = it cannot be undone.
    """

    author: str = AUTHOR
    action: str | None = None


PROGRAM = Importer()


@dataclass(frozen=True)
class MatchedFrames:
    """A dataset's frames in a project.

    Attributes:
        matched: each name with the project's frame, in the project's order.
        unmatched: names of frames that the project does not have.
        renamed: the dataset's only recording, if it was matched with one of another name.
    """

    matched: tuple[tuple[str, StoredFrame], ...]
    unmatched: tuple[str, ...]
    renamed: Renamed | None


def match_frames(project: Project, path: Path, names: Sequence[str], recording: str | None = None) -> MatchedFrames:
    """Finds the project's frames of a dataset's frame names.

    Args:
        path: the dataset, for messages.
        names: "RECORDING/KEY", or "KEY" alone; all different.
        recording: the only recording to look in.

    Raises:
        FormatError: a name fits frames of several recordings, two names fit one frame, or none fits any.
        NotFoundError: no such recording.
    """
    found, finder = found_frames(project, names, recording)
    matched: dict[int, tuple[str, StoredFrame]] = {}
    unmatched = []
    for name, frames in found.items():
        if len(frames) > 1:
            several = ", ".join(map(finder.recording_of, frames))
            raise FormatError(path, f"{name} is a frame of several recordings ({several}); choose one with --recording")
        if not frames:
            unmatched.append(name)
        elif frames[0].id in matched:
            raise FormatError(path, f"{matched[frames[0].id][0]} and {name} both match frame {frames[0].key}; keep one")
        else:
            matched[frames[0].id] = (name, frames[0])
    if not matched:
        raise none_of(path, names)
    keys = {stored.key for _, stored in matched.values()}
    renamed = finder.renamed(stored for name, stored in matched.values() if name not in keys)
    order = {frame.id: place for place, frame in enumerate(project.frames.of())}
    in_order = sorted(matched.values(), key=lambda pair: order[pair[1].id])
    return MatchedFrames(tuple(in_order), tuple(unmatched), renamed)


def found_frames(
    project: Project, names: Sequence[str], recording: str | None
) -> tuple[dict[str, list[StoredFrame]], FrameFinder]:
    """Returns the project's frames that each name fits, and what found them. Arguments as `match_frames`."""
    keys = {normal(frame.key) for frame in project.frames.of()}
    # a recording's name cannot contain "/", a key can
    places = {name: (None, name) if normal(name) in keys or "/" not in name else _place(name) for name in names}
    finder = FrameFinder(project, recording, {place[0] for place in places.values() if place[0] is not None})
    return {name: finder.find(*place) for name, place in places.items()}, finder


def none_of(path: Path, names: Sequence[str]) -> FormatError:
    """The error for a dataset without a frame of the project."""
    if not names:
        return FormatError(path, "has no frames, so there is nothing to import")
    shown = ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")
    return FormatError(
        path, f"the project has none of the dataset's frames ({shown}); first add their recording (`annotator add`)"
    )


def _place(name: str) -> tuple[str, str]:
    recording, _, key = name.partition("/")
    return recording, key
