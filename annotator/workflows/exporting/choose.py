"""Selects the labels of a project to export, and divides their frames into parts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from annotator.project import REVIEWED, Project, StoredFrame, StoredLabel
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.types.messages import alternatives, amount
from annotator.workflows.exporting.split import Split, assign
from annotator.workflows.rigs import once

NOT_REJECTED = (ReviewState.PROPOSED, *REVIEWED)


@dataclass(frozen=True)
class ExportFilter:
    """The labels to export.

    Attributes:
        states: review states; None = the format's default.
        classes: class names; None = all of the project.
        recordings: ids; None = all.
        empty_frames: also export frames without such a label, if they are still in their recordings.
        skip_unreadable: leave out frames that cannot be read; otherwise such a frame ends the export with an error.
    """

    states: tuple[ReviewState, ...] | None = None
    classes: tuple[str, ...] | None = None
    recordings: tuple[int, ...] | None = None
    empty_frames: bool = False
    skip_unreadable: bool = False


@dataclass(frozen=True, eq=False)
class Chosen:
    """One frame to export.

    Attributes:
        stored: the frame.
        recording: its recording's name.
        labels: its labels to export.
        split: its part of the dataset; None for a dataset without parts.
    """

    stored: StoredFrame
    recording: str
    labels: tuple[StoredLabel, ...]
    split: str | None


def choose_frames(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...], split: Split | None
) -> list[Chosen]:
    """Returns the frames to export, in the project's order.

    Args:
        states: the states of `choose`, or the format's default.
        split: how they are divided into parts.

    Raises:
        ConfigError: the project has no such class, no label fits, or there are too few frames for the parts.
    """
    labels = once(project, labels_by_frame(project, choose, states))
    if not labels and not choose.empty_frames:
        raise ConfigError(_no_labels(project, choose, states))
    every = project.frames.of(choose.recordings)
    frames = [f for f in every if f.id in labels or (choose.empty_frames and f.index is not None)]
    return divided(project, frames, labels, split)


def waiting_note(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...], chosen: Sequence[Chosen]
) -> str | None:
    """Returns a note about exported frames with unreviewed proposals, which are left out; None if there are none."""
    if ReviewState.PROPOSED in states:
        return None
    exported = {each.stored.id for each in chosen}
    proposed = project.labels.select(
        states=[ReviewState.PROPOSED], recordings=choose.recordings, classes=choose.classes
    )
    frames = [entry.frame_id for entry in proposed if entry.frame_id in exported]
    if not frames:
        return None
    return (
        f"left out: {amount(len(frames), 'unreviewed proposal')} on {len(set(frames))} of these frames; finish the "
        "review first if the labels must be complete"
    )


def labels_by_frame(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...]
) -> dict[int, tuple[StoredLabel, ...]]:
    """Returns the labels to export, by frame id.

    Raises:
        ConfigError: the project has no such class.
    """
    name, classes = project.config.name, project.config.classes
    if unknown := sorted(set(choose.classes or ()) - set(classes)):
        raise ConfigError(f"project {name} has no class {unknown[0]!r}; {alternatives(unknown[0], classes)}")
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
    """Returns the frames with their labels and parts.

    Raises:
        ConfigError: there are too few frames for the parts.
    """
    names = {recording.id: recording.name for recording in project.recordings.all()}
    places = [(names[f.recording_id], f.key) for f in frames]
    parts = [None] * len(frames) if split is None else assign(split, places)
    return [
        Chosen(frame, place[0], labels.get(frame.id, ()), part)
        for frame, place, part in zip(frames, places, parts, strict=True)
    ]


def _no_labels(project: Project, choose: ExportFilter, states: tuple[ReviewState, ...]) -> str:
    """Returns the error message for a filter that no label matches."""
    others = [state for state in (ReviewState.PROPOSED,) if state not in states]
    waiting = len(project.labels.select(states=others, recordings=choose.recordings, classes=choose.classes))
    advice = (
        f"{waiting} are proposed and not reviewed: review them (`annotator serve`), or also choose the state proposed "
        "to export them as they are"
        if others and waiting
        else "run `annotator annotate` first, or choose other states"
    )
    return f"project {project.config.name} has no labels in state {', '.join(states)} to export; {advice}"
