"""Which labels of a project leave, and in which parts of the dataset."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from annotator.project import Project, StoredFrame, StoredLabel
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.exporting.split import Split, assign


@dataclass(frozen=True)
class ExportFilter:
    """Which labels leave.

    Attributes:
        states: in which review states; None = those that the format takes by itself.
        classes: None = all of the project's.
        recordings: ids; None = all.
        empty_frames: also frames without any such label, as far as they are still in their recordings.
        skip_unreadable: leave out frames that cannot be read, where otherwise one of them ends the export.
    """

    states: tuple[ReviewState, ...] | None = None
    classes: tuple[str, ...] | None = None
    recordings: tuple[int, ...] | None = None
    empty_frames: bool = False
    skip_unreadable: bool = False


@dataclass(frozen=True, eq=False)
class Chosen:
    """One frame that leaves.

    Attributes:
        stored: the frame.
        recording: its recording's name.
        labels: those of its labels that leave.
        split: the part that it belongs to; None where the dataset is not divided.
    """

    stored: StoredFrame
    recording: str
    labels: tuple[StoredLabel, ...]
    split: str | None


def choose_frames(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...], split: Split | None
) -> list[Chosen]:
    """The frames that leave, in the project's order.

    Args:
        states: those of `choose`, or the format's own.
        split: how they are divided.

    Raises:
        ConfigError: the project has no such class, no label fits, or there are too few frames for a part.
    """
    labels = labels_by_frame(project, choose, states)
    if not labels and not choose.empty_frames:
        raise ConfigError(_nothing(project, choose, states))
    every = project.frames.of(choose.recordings)
    frames = [f for f in every if f.id in labels or (choose.empty_frames and f.index is not None)]
    return divided(project, frames, labels, split)


def waiting_note(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...], chosen: Sequence[Chosen]
) -> str | None:
    """What to know of frames that leave as complete, while some of their objects wait for a review; None: all leave."""
    if ReviewState.PROPOSED in states:
        return None
    leaving = {each.stored.id for each in chosen}
    left = project.labels.select(states=[ReviewState.PROPOSED], recordings=choose.recordings, classes=choose.classes)
    frames = [entry.frame_id for entry in left if entry.frame_id in leaving]
    if not frames:
        return None
    return (
        f"{len(frames)} proposals wait for a review on {len(set(frames))} of these frames, and were left out; "
        "review them first where the labels shall be complete"
    )


def labels_by_frame(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...]
) -> dict[int, tuple[StoredLabel, ...]]:
    """The labels that leave, by frame.

    Raises:
        ConfigError: the project has no such class.
    """
    name, classes = project.config.name, project.config.classes
    if unknown := sorted(set(choose.classes or ()) - set(classes)):
        raise ConfigError(f"project {name} has no class {', '.join(unknown)}; it has {', '.join(classes)}")
    labels: dict[int, list[StoredLabel]] = defaultdict(list)
    for entry in project.labels.select(states=states, recordings=choose.recordings, classes=choose.classes):
        labels[entry.frame_id].append(entry)
    return {frame: tuple(entries) for frame, entries in labels.items()}


def divided(
    project: Project,
    frames: Sequence[StoredFrame],
    labels: Mapping[int, tuple[StoredLabel, ...]],
    split: Split | None,
) -> list[Chosen]:
    """These frames with their labels and parts.

    Raises:
        ConfigError: there are too few frames for a part.
    """
    names = {recording.id: recording.name for recording in project.recordings.all()}
    places = [(names[f.recording_id], f.key) for f in frames]
    parts = [None] * len(frames) if split is None else assign(split, places)
    return [
        Chosen(frame, place[0], labels.get(frame.id, ()), part)
        for frame, place, part in zip(frames, places, parts, strict=True)
    ]


def _nothing(project: Project, choose: ExportFilter, states: tuple[ReviewState, ...]) -> str:
    """Why nothing leaves, and what would."""
    others = [state for state in (ReviewState.PROPOSED,) if state not in states]
    waiting = len(project.labels.select(states=others, recordings=choose.recordings, classes=choose.classes))
    advice = (
        f"{waiting} are proposed and wait for a review (`annotator serve`); to export them as they are, choose the "
        "state proposed, too"
        if others and waiting
        else "run `annotator annotate` first, or choose other states"
    )
    return f"project {project.config.name} has no labels in state {', '.join(states)} to export; {advice}"
