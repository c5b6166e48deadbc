"""Imports 3D boxes for the frames of a project."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from annotator.project import FramePart, NewLabel, Project, StoredFrame, WriteContext
from annotator.project.classes.completing import ValueReader
from annotator.project.log.event_types import FrameAttributesSet
from annotator.text import normal
from annotator.types import Frame, Source, Truth
from annotator.types.errors import FormatError, FrameError, StaleRevisionError
from annotator.types.label import AttributeValue, Said
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.class_names import NO_NAMES, renamed_class
from annotator.workflows.importing.frame_finder import FrameFinder, Renamed
from annotator.workflows.importing.label_set import FoundInProject, HasFrameValues, HasUnseen, LabelSet
from annotator.workflows.importing.missing_values import give_missing_values
from annotator.workflows.importing.size_doubts import SizeDoubts

AUTHOR = "import"
# No sensor sees so far.
FARTHEST_BOX_M = 10_000.0


@dataclass(frozen=True)
class Importer:
    """Who imports.

    Attributes:
        action: id of the action (`project.new_action`) that undoes the whole import; None = it cannot be undone.
    """

    author: str = AUTHOR
    action: str | None = None


PROGRAM = Importer()


@dataclass
class ImportedLabels:
    """The result of an import.

    Attributes:
        frames: number of frames that got labels, or are empty in the dataset.
        labels: number of labels by class.
        other_classes: boxes left out because the project has no such class, by class.
        already: number of frames left unchanged because they have labels or are finalised.
        unmatched: names of labelled frames that the project does not have.
        unreadable: frames that cannot be read, as `key: reason`.
        not_reviewed: number of boxes on `frames` left out because they are not accepted in the dataset.
        unseen: number of boxes left out because they are outside the images of all frames that were read.
        scores: number of scores on `frames` left out because they are not confidences in 0..1.
        flat: number of 2D boxes on `frames` left out because they have no 3D box.
        tracks: number of track ids on `frames` left out because an earlier box of the frame has the same one.
        values: values of attributes left out, with the reason, because the project's attributes cannot hold them.
        filled: number of values that labels and frames among `already` got.
        doubt: what the sizes of the boxes show if they hardly are in metres, or in the order length, width, height.
        renamed: the dataset's only recording, if it was matched with one of another name.
    """

    frames: int = 0
    labels: Counter[str] = field(default_factory=Counter)
    other_classes: Counter[str] = field(default_factory=Counter)
    already: int = 0
    unmatched: tuple[str, ...] = ()
    unreadable: list[str] = field(default_factory=list)
    not_reviewed: int = 0
    unseen: int = 0
    scores: int = 0
    flat: int = 0
    tracks: int = 0
    values: Counter[str] = field(default_factory=Counter)
    filled: int = 0
    doubt: str | None = None
    renamed: Renamed | None = None


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


def import_labels(
    project: Project,
    dataset: LabelSet,
    recording: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer = PROGRAM,
    fill: bool = False,
) -> ImportedLabels:
    """Imports the boxes of every frame without labels; each becomes an accepted label with the source imported.

    Args:
        recording: name of the recording of plain frame names, if several recordings have such frames.
        progress: called with (frames done, frames).
        names: the project's class of each class of the dataset; classes that are not listed keep their names.
        fill: give labels that frames have already, and these frames, the values of attributes that they lack. Finalised
            frames stay as they are.

    Raises:
        FormatError: none of the labelled frames is in the project, or a name fits several.
        NotFoundError: no such recording.
        RecordingError: a recording has been moved.
    """
    dataset = dataset.in_project(project) if isinstance(dataset, FoundInProject) else dataset
    frames = match_frames(project, dataset.path, dataset.frames, recording)
    source, done = FrameSource(project), ImportedLabels(unmatched=frames.unmatched, renamed=frames.renamed)
    reader = _Importer(project, dataset, names, importer, done)
    for number, (name, stored) in enumerate(frames.matched, 1):
        is_labelled = stored.finalised or bool(project.labels.of_frame(stored.id))
        if is_labelled:
            done.already += 1
        if not is_labelled or (fill and not stored.finalised and reader.has_values(name)):
            try:
                truths = truths_of(dataset, name, source.read(stored))
            except FrameError as error:
                done.unreadable.append(f"{stored.key}: {error}")
            else:
                (reader.fill if is_labelled else reader.add)(name, stored, truths)
        if progress is not None:
            progress(number, len(frames.matched))
    done.values = reader.left_out
    done.doubt = reader.sizes.problem()
    done.unseen = dataset.unseen() if isinstance(dataset, HasUnseen) else 0
    return done


class _Importer:
    def __init__(
        self, project: Project, dataset: LabelSet, names: Mapping[str, str], importer: Importer, done: ImportedLabels
    ) -> None:
        self._project, self._dataset, self._names = project, dataset, names
        self._importer, self._done = importer, done
        config = project.config
        self._classes = set(config.classes)
        self._attributes = {each.name for each in config.attributes}
        self._reader = ValueReader(config.attributes)
        self.sizes = SizeDoubts()

    @property
    def left_out(self) -> Counter[str]:
        """Values that the project cannot hold."""
        return self._reader.left_out

    def has_values(self, name: str) -> bool:
        """Whether a frame of the dataset has values of the project's attributes; no frame is read."""
        of_frame = self._dataset.values_of(name) if isinstance(self._dataset, HasFrameValues) else {}
        return any(self._attributes & values.keys() for values in (of_frame, *self._dataset.values_of_boxes(name)))

    def add(self, name: str, stored: StoredFrame, truths: Sequence[Truth]) -> None:
        """Stores the labels and values of a frame without labels."""
        done = self._done
        named = [(t, renamed_class(t.label, self._names)) for t in truths]
        for truth, label in named:
            self.sizes.add(label, truth.box.size_m)
        done.other_classes.update(t.label for t, label in named if label not in self._classes)
        new, repeated = with_tracks_once(self._labels(truths))
        if create_if_unlabelled(self._project, stored.id, new, self._importer.author, self._importer.action):
            self._give_frame(name, stored)
            done.frames += 1
            done.labels.update(label.label for label in new)
            left_out = self._dataset.left_out_of(name)
            done.not_reviewed += left_out.not_reviewed
            done.scores += left_out.scores
            done.flat += left_out.flat
            done.tracks += repeated
        else:
            done.already += 1

    def fill(self, name: str, stored: StoredFrame, truths: Sequence[Truth]) -> None:
        """Stores the values that a frame and its labels lack."""
        given = self._labels(truths)
        importer = self._importer
        self._done.filled += give_missing_values(self._project, stored.id, given, importer.author, importer.action)
        self._done.filled += self._give_frame(name, stored)

    def _labels(self, truths: Sequence[Truth]) -> list[NewLabel]:
        named = [(t, renamed_class(t.label, self._names)) for t in truths]
        return [
            NewLabel(
                label,
                t.box,
                t.score,
                t.track_id,
                box_kind=t.box_kind,
                attributes=self._reader.of_label(label, t.attributes),
                said=_known(t.said, self._names, self._classes),
            )
            for t, label in named
            if label in self._classes
        ]

    def _give_frame(self, name: str, stored: StoredFrame) -> int:
        if not isinstance(self._dataset, HasFrameValues):
            return 0
        values = self._reader.of_frame(self._dataset.values_of(name))
        return _set_values(self._project, stored.id, values, self._importer) if values else 0


def _known(said: Sequence[Said], names: Mapping[str, str], classes: Collection[str]) -> tuple[Said, ...]:
    """Returns what sources said, in the project's classes; nothing of other classes."""
    named = (replace(each, label=renamed_class(each.label, names)) for each in said)
    return tuple(each for each in named if each.label in classes)


def _set_values(project: Project, frame_id: int, values: Mapping[str, AttributeValue], importer: Importer) -> int:
    """Gives a frame the values that it lacks; returns how many."""
    while True:
        present = project.frames.attributes_of(frame_id)
        missing = dict(values) | present
        if len(missing) == len(present):
            return 0
        revision = project.frames.get(frame_id).revision
        with suppress(StaleRevisionError):
            context = WriteContext(revision, importer.author, Source.IMPORTED)
            part = FramePart(frame_id, [FrameAttributesSet(attributes=missing)], context)
            project.log.append_to_frames([part], importer.action)
            return len(missing) - len(present)


def truths_of(dataset: LabelSet, name: str, frame: Frame) -> Sequence[Truth]:
    """Returns the objects of a frame of a dataset, boxes in the camera frame. Raises FormatError: as `within_range`."""
    with within_range(dataset, name):
        return near(dataset.truths(name, frame))


def near(truths: Sequence[Truth]) -> Sequence[Truth]:
    """Returns objects that may be seen by their camera.

    Raises:
        ValueError: the box of one is too far away: its format has boxes relative to the camera, or to another place.
    """
    for truth in truths:
        away_m = float(np.linalg.norm(truth.box.center_m))
        if away_m > FARTHEST_BOX_M:
            raise ValueError(
                f"a box of {truth.label} is {away_m / 1000:,.0f} km from the camera: its coordinates are a map's, "
                "but this format's, or the recording's, are not"
            )
    return truths


@contextmanager
def within_range(dataset: LabelSet, name: str) -> Iterator[None]:
    """While the boxes of a frame are read.

    Raises:
        FormatError: the transform to the camera frame moves a box out of range; or as `LabelSet.truths`.
    """
    try:
        yield
    except ValueError as error:
        raise FormatError(dataset.path, f"{name}: {error}; correct its boxes or its calibration") from error


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


def with_tracks_once(new: Sequence[NewLabel]) -> tuple[list[NewLabel], int]:
    """Returns a frame's labels, the first box of each track with its id, the others without; and how many these are."""
    taken, kept = set[int | None](), list[NewLabel]()
    for label in new:
        kept.append(replace(label, track_id=None, file_track_id=None) if label.track_id in taken else label)
        taken |= {label.track_id} - {None}
    return kept, sum(before is not after for before, after in zip(new, kept, strict=True))


def create_if_unlabelled(
    project: Project, frame_id: int, new: Sequence[NewLabel], author: str, action: str | None = None
) -> bool:
    """Stores imported labels; returns False if the frame has labels or is finalised, even by a concurrent edit.

    A finalised frame without labels is confirmed as empty.
    """
    while True:
        stored = project.frames.get(frame_id)
        if stored.finalised or project.labels.of_frame(frame_id):
            return False
        if not new:
            return True
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            project.labels.create(frame_id, new, WriteContext(stored.revision, author, Source.IMPORTED), action)
            return True
