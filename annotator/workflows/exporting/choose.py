"""Selects the labels, or the images and pseudo-views, of a project to export, and divides its frames into parts."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np

from annotator.formats.dataset_writing import Losses, Lost
from annotator.project import REVIEWED, ImageBoxes, Project, StoredFrame, StoredLabel, ViewBoxes
from annotator.types import Box2D, ReviewState
from annotator.types.errors import ConfigError
from annotator.types.messages import alternatives, amount

# Parts become the names of files and folders.
NAME = re.compile(r"[A-Za-z0-9_-]{1,32}")
# Shares may be rounded: 0.33 three times.
SUM_TOLERANCE = 0.015


class SplitBy(StrEnum):
    """The unit that stays in one part: a frame, or a whole recording (whose frames are similar)."""

    FRAMES = "frames"
    RECORDINGS = "recordings"


@dataclass(frozen=True)
class Split:
    """How a dataset is divided.

    Attributes:
        shares: each part's fraction of the frames; the sum is 1.
        by: divide by frames or by whole recordings.
        seed: seed of the random order.
    """

    shares: Mapping[str, float]
    by: SplitBy = SplitBy.FRAMES
    seed: int = 0


def parse_shares(text: str) -> dict[str, float]:
    """Parses shares such as "train=0.8,val=0.2", or ratios such as "train=4,val=1"."""
    shares: dict[str, float] = {}
    for part in text.split(","):
        name, sign, share = (word.strip() for word in part.partition("="))
        try:
            value = float(share)
        except ValueError:
            value = math.nan
        if not sign or not NAME.fullmatch(name) or not (0 < value < math.inf) or name in shares:
            raise ConfigError(
                f"{text!r} is not a valid split: give each part once with its share, as in train=0.8,val=0.2"
            )
        shares[name] = value
    total = sum(shares.values())
    if abs(total - 1) > SUM_TOLERANCE and not all(share.is_integer() for share in shares.values()):
        fitting = ",".join(f"{name}={share / total:.2g}" for name, share in shares.items())
        raise ConfigError(
            f"the shares of the split {text!r} add up to {total:.3g}, not to 1; write {fitting}, or ratios in whole "
            "numbers, as in train=4,val=1"
        )
    return {name: share / total for name, share in shares.items()}


def assign(split: Split, places: Sequence[tuple[str, str]]) -> list[str]:
    """Returns the part of each frame, independent of the order of the frames.

    Args:
        places: each frame's recording and key, all different.
    """
    groups = [(recording,) if split.by is SplitBy.RECORDINGS else (recording, key) for recording, key in places]
    sizes = Counter[tuple[str, ...]](groups)
    if len(sizes) < len(split.shares):
        raise ConfigError(
            f"{amount(len(sizes), split.by.removesuffix('s'))} cannot be divided into "
            f"{amount(len(split.shares), 'part')} ({', '.join(split.shares)}); give fewer parts, or divide by frames"
        )
    missing = {part: share * len(places) for part, share in split.shares.items()}
    names, empty, part_of = sorted(sizes), set(missing), dict[tuple[str, ...], str]()
    for left, place in zip(
        range(len(names), 0, -1), np.random.default_rng(split.seed).permutation(len(names)), strict=True
    ):
        # each to the part that lacks the most frames; every part gets at least one. In the order of the shares: of
        # equal values, max() takes the first, and a set has no fixed order
        candidates = [name for name in missing if name in empty or left > len(empty)]
        part = part_of[names[place]] = max(candidates, key=missing.__getitem__)
        missing[part] -= sizes[names[place]]
        empty.discard(part)
    return [part_of[group] for group in groups]


NOT_REJECTED = (ReviewState.PROPOSED, *REVIEWED)


@dataclass(frozen=True)
class ExportFilter:
    """The labels to export.

    Attributes:
        states: review states; None = the format's default.
        classes: class names; None = all of the project.
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
    """
    labels = labels_by_frame(project, choose, states)
    if not labels and not choose.empty_frames:
        waiting = 0 if ReviewState.PROPOSED in states else len(_selected(project, choose, [ReviewState.PROPOSED]))
        advice = (
            f"{waiting} are proposed and not reviewed: review them (`annotator serve`), or also choose the state "
            "proposed to export them as they are"
            if waiting
            else "run `annotator annotate` first, or choose other states"
        )
        raise ConfigError(
            f"project {project.config.name} has no labels in state {', '.join(states)} to export; {advice}"
        )
    every = project.frames.of(choose.recordings)
    frames = [f for f in every if f.id in labels or (choose.empty_frames and f.index is not None)]
    return divided(project, frames, labels, split)


def _selected(project: Project, choose: ExportFilter, states: Sequence[ReviewState]) -> Sequence[StoredLabel]:
    return project.labels.select(states=states, recordings=choose.recordings, classes=choose.classes)


def waiting_note(
    project: Project, choose: ExportFilter, states: tuple[ReviewState, ...], chosen: Sequence[Chosen]
) -> str | None:
    """Returns a note about exported frames with unreviewed proposals, which are left out; None if there are none."""
    if ReviewState.PROPOSED in states:
        return None
    exported = {each.stored.id for each in chosen}
    proposed = _selected(project, choose, [ReviewState.PROPOSED])
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
    """Returns the labels to export, by frame id."""
    name, classes = project.config.name, project.config.classes
    if unknown := sorted(set(choose.classes or ()) - set(classes)):
        raise ConfigError(f"project {name} has no class {unknown[0]!r}; {alternatives(unknown[0], classes)}")
    labels: dict[int, list[StoredLabel]] = defaultdict(list)
    for entry in _selected(project, choose, states):
        labels[entry.frame_id].append(entry)
    return {frame: tuple(entries) for frame, entries in labels.items()}


def divided(
    project: Project,
    frames: Sequence[StoredFrame],
    labels: Mapping[int, tuple[StoredLabel, ...]],
    split: Split | None,
) -> list[Chosen]:
    """Returns the frames with their labels and parts."""
    names = {recording.id: recording.name for recording in project.recordings.all()}
    places = [(names[f.recording_id], f.key) for f in frames]
    parts = [None] * len(frames) if split is None else assign(split, places)
    return [
        Chosen(frame, place[0], labels.get(frame.id, ()), part)
        for frame, place, part in zip(frames, places, parts, strict=True)
    ]


Pictures = Literal["images", "views", "both"]


@dataclass(frozen=True, eq=False)
class ChosenPictures(Chosen):
    """The images of one frame to export.

    Attributes:
        image: True to export the camera image.
        drawn: the boxes drawn on it; the frame's other labels are projected onto it.
        views: labelled pseudo-views of the frame to export.
    """

    image: bool
    drawn: ImageBoxes | None
    views: Sequence[ViewBoxes]


def choose_pictures(
    project: Project,
    choose: ExportFilter,
    states: tuple[ReviewState, ...],
    split: Split | None,
    pictures: Pictures,
    losses: Losses,
) -> list[ChosenPictures]:
    """Returns the frames whose images are exported, in the project's order.

    A camera image is exported with the boxes drawn on it, and with the outlines of the frame's other labels. An image
    without boxes is exported as background if an operator confirmed it: its drawn boxes were saved as empty, or the
    frame is finalised and has only rejected labels. An image with unreviewed proposals and without drawn boxes is not
    exported, because a detector would learn to treat these objects as background.
    """
    labels = labels_by_frame(project, choose, states)
    images = {b.frame_id: b for b in project.boxes.on_images(choose.recordings)} if pictures != "views" else {}
    views = defaultdict[int, list[ViewBoxes]](list)
    for view in project.boxes.on_views() if pictures != "images" else ():
        if view.frame_id is not None and _is_drawn(view.boxes, choose):
            views[view.frame_id].append(view)
    with_image = _exported(project, choose, states, labels, images, losses) if pictures != "views" else set()
    shown = with_image | views.keys()
    frames = [frame for frame in project.frames.of(choose.recordings) if frame.id in shown]
    if not frames and not loose_views(project, choose, pictures):
        raise ConfigError(
            f"project {project.config.name} has no labelled {'images or views' if pictures == 'both' else pictures} to "
            "export; draw boxes, or review proposals (`annotator serve`)"
        )
    return [
        ChosenPictures(
            **vars(c), image=c.stored.id in with_image, drawn=images.get(c.stored.id), views=views[c.stored.id]
        )
        for c in divided(project, frames, labels, split)
    ]


def loose_views(project: Project, choose: ExportFilter, pictures: Pictures) -> list[ViewBoxes]:
    """Returns labelled pseudo-views without a frame: imported, for training only."""
    if pictures == "images" or choose.recordings is not None:
        return []
    return [view for view in project.boxes.on_views() if view.frame_id is None and _is_drawn(view.boxes, choose)]


def of_classes(boxes: Sequence[Box2D], classes: Collection[str] | None) -> list[Box2D]:
    """Returns the boxes of the given classes; None = all."""
    return [box for box in boxes if classes is None or box.label in classes]


def _is_drawn(boxes: Sequence[Box2D], choose: ExportFilter) -> bool:
    """True for an image with a box of the chosen classes, or one confirmed as empty."""
    return not boxes or choose.empty_frames or bool(of_classes(boxes, choose.classes))


def _exported(
    project: Project,
    choose: ExportFilter,
    states: tuple[ReviewState, ...],
    labels: Mapping[int, tuple[StoredLabel, ...]],
    images: Mapping[int, ImageBoxes],
    losses: Losses,
) -> set[int]:
    """Returns the frames whose camera images are exported; counts those that only unreviewed proposals prevent."""
    # all states except rejected: an object is not background, even if its state was not chosen
    existing = _selected(project, choose, NOT_REJECTED)
    with_object = {entry.frame_id for entry in existing}
    waiting = {entry.frame_id for entry in existing if entry.label.state is ReviewState.PROPOSED}
    chosen = set()
    for frame in project.frames.of(choose.recordings):
        drawn = images.get(frame.id)
        if drawn is not None:
            is_exported = _is_drawn(drawn.boxes, choose)
        elif frame.id in waiting and ReviewState.PROPOSED not in states:
            losses.add(Lost.OPEN, int(frame.id in labels))
            is_exported = False
        elif frame.id in labels or frame.id in with_object:
            is_exported = frame.id in labels
        else:
            is_exported = frame.index is not None and (frame.finalised or choose.empty_frames)
        chosen |= {frame.id} if is_exported else set()
    return chosen
