"""The project's frames and classes of a dataset's names."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Generic, NamedTuple, TypeVar

from annotator.project import Project, StoredFrame
from annotator.text import normal
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import alternatives, folded, nearest

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

NO_NAMES: Mapping[str, str] = MappingProxyType({})


def class_names(text: str, project: Project) -> dict[str, str]:
    """Parses `Car=car,Pedestrian=person`: classes of a file, and the project's classes that they become."""
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


class OwnClasses:
    """The project's class of each class of a dataset: as `names` says, else one of the same name.

    A name that only case, spaces, `-` or `_` set apart is the same, unless the project itself sets two so apart. In
    `names`, "" is no class.
    """

    def __init__(self, classes: Collection[str], names: Mapping[str, str] = NO_NAMES) -> None:
        self._names = dict(names) | {name: name for name in classes if name not in names}
        alike = Counter(map(folded, classes))
        self._folded = {folded(name): name for name in classes if alike[folded(name)] == 1}
        self._classes = frozenset(classes)

    def of(self, theirs: str) -> str | None:
        """The project's class; None without one."""
        ours = self._names[theirs] if theirs in self._names else self._folded.get(folded(theirs))
        return ours if ours in self._classes else None


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
    """Returns a line for each class in `names` that a dataset does not have."""
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

    def __str__(self) -> str:
        return f"{self.named} of the labels was assigned to {', '.join(self.taken_for)}"


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


class Place(NamedTuple, Generic[T]):
    """What a dataset says of the place of one of its frames or images.

    Attributes:
        thing: the frame or image.
        name: its name in the dataset, for messages.
        recording: name of its recording; None if the dataset does not say it.
        key: of the frame.
    """

    thing: T
    name: str
    recording: str | None
    key: str


@dataclass(frozen=True)
class Matched(Generic[T_co]):
    """A dataset's frames or images with their frames in a project.

    Attributes:
        matched: each with the project's frame, in the project's order.
        unmatched: names of those without a frame in the project.
        renamed: the dataset's only recording, if it was matched with one of another name.
        ambiguous: those that fit frames of several recordings, with the names of these.
    """

    matched: tuple[tuple[T_co, StoredFrame], ...]
    unmatched: tuple[str, ...] = ()
    renamed: Renamed | None = None
    ambiguous: tuple[tuple[T_co, str, tuple[str, ...]], ...] = ()

    def require_clear(self, path: Path) -> Matched[T_co]:
        """Returns itself. Raises FormatError: something fits frames of several recordings."""
        for _, name, recordings in self.ambiguous:
            several = ", ".join(recordings)
            raise FormatError(path, f"{name} is a frame of several recordings ({several}); choose one with --recording")
        return self


MatchedFrames = Matched[str]
"""The frames of a dataset by their names."""


def match(
    project: Project, path: Path, places: Sequence[Place[T]], recording: str | None, nothing: FormatError
) -> Matched[T]:
    """Finds the project's frames of a dataset's frames or images.

    Keys such as 000012 occur in many recordings, so frames of another recording do not match. Exception: if the
    dataset has a single recording and the project has none of this name, it is matched with the project's recordings
    by key alone, and `renamed` reports it.
    """
    chosen = None if recording is None else [project.recordings.find(recording).id]
    names = {each.id: each.name for each in project.recordings.all()}
    # by recording and key; by None and key, those of all recordings
    frames: dict[tuple[str | None, str], list[StoredFrame]] = defaultdict(list)
    for frame in project.frames.of(chosen):
        for name in (None, names[frame.recording_id]):
            frames[name, normal(frame.key)].append(frame)
    named = {each.recording for each in places if each.recording is not None}
    unknown = named if len(named) == 1 and not named & {name for name, _ in frames} else set[str]()
    matched: dict[int, tuple[Place[T], StoredFrame]] = {}
    unmatched, ambiguous, taken_for = [], [], dict[str, None]()
    for place in places:
        found = frames.get((None if place.recording in unknown else place.recording, normal(place.key)), [])
        recordings = tuple(names[frame.recording_id] for frame in found)
        if place.recording is not None:
            taken_for |= dict.fromkeys(recordings)
        if len(found) > 1:
            ambiguous.append((place.thing, place.name, recordings))
        elif not found:
            unmatched.append(place.name)
        elif found[0].id in matched:
            other = matched[found[0].id][0].name
            raise FormatError(path, f"{other} and {place.name} both match frame {found[0].key}; keep one of them")
        else:
            matched[found[0].id] = (place, found[0])
    if not matched and not ambiguous:
        raise nothing
    order = {frame.id: number for number, frame in enumerate(project.frames.of())}
    in_order = sorted(matched.values(), key=lambda pair: order[pair[1].id])
    return Matched(
        tuple((place.thing, stored) for place, stored in in_order),
        tuple(unmatched),
        Renamed(next(iter(unknown)), tuple(taken_for)) if unknown and taken_for else None,
        tuple(ambiguous),
    )


def match_frames(project: Project, path: Path, names: Sequence[str], recording: str | None = None) -> MatchedFrames:
    """Finds the project's frames of a dataset's frame names; some may be of several recordings.

    Args:
        names: "RECORDING/KEY", or "KEY" alone; all different.
    """
    keys = {normal(frame.key) for frame in project.frames.of()}
    # a recording's name cannot contain "/", a key can
    places = [
        Place(name, name, None, name)
        if normal(name) in keys or "/" not in name
        else Place(name, name, *name.split("/", 1))
        for name in names
    ]
    return match(project, path, places, recording, _none_of(path, names))


def _none_of(path: Path, names: Sequence[str]) -> FormatError:
    if not names:
        return FormatError(path, "has no frames, so there is nothing to import")
    shown = ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")
    return FormatError(
        path, f"the project has none of the dataset's frames ({shown}); first add their recording (`annotator add`)"
    )
