"""Selects the camera images and pseudo-views of a project to export in a format of 2D boxes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from annotator.formats.losses import Losses, Lost
from annotator.project import ImageBoxes, Project, StoredFrame, StoredLabel, ViewBoxes
from annotator.types import Box2D, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.exporting.choose import NOT_REJECTED, Chosen, ExportFilter, divided, labels_by_frame
from annotator.workflows.exporting.split import Split

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
    views: tuple[ViewBoxes, ...]


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

    Args:
        states: review states of the labels to export.
        losses: counts the images that are not exported.

    Raises:
        ConfigError: the project has no such class, no image fits, or there are too few frames for the parts.
    """
    labels = labels_by_frame(project, choose, states)
    images = {b.frame_id: b for b in project.boxes.on_images(choose.recordings)} if pictures != "views" else {}
    views = _views_by_frame(project, choose) if pictures != "images" else {}
    selection = _Images(project, choose, states, labels, images) if pictures != "views" else None
    frames: list[StoredFrame] = []
    with_image: set[int] = set()
    for frame in project.frames.of(choose.recordings):
        if selection is not None and selection.is_exported(frame, losses):
            with_image.add(frame.id)
        if frame.id in with_image or frame.id in views:
            frames.append(frame)
    if not frames and not loose_views(project, choose, pictures):
        raise ConfigError(
            f"project {project.config.name} has no labelled {'images or views' if pictures == 'both' else pictures} to "
            "export; draw boxes, or review proposals (`annotator serve`)"
        )
    return [
        ChosenPictures(
            c.stored,
            c.recording,
            c.labels,
            c.split,
            c.stored.id in with_image,
            images.get(c.stored.id),
            tuple(views.get(c.stored.id, ())),
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


def _views_by_frame(project: Project, choose: ExportFilter) -> dict[int, list[ViewBoxes]]:
    views: dict[int, list[ViewBoxes]] = defaultdict(list)
    for view in project.boxes.on_views():
        if view.frame_id is not None and _is_drawn(view.boxes, choose):
            views[view.frame_id].append(view)
    return views


class _Images:
    """Decides which camera images are exported."""

    def __init__(
        self,
        project: Project,
        choose: ExportFilter,
        states: tuple[ReviewState, ...],
        labels: dict[int, tuple[StoredLabel, ...]],
        images: dict[int, ImageBoxes],
    ) -> None:
        self._choose, self._labels, self._images = choose, labels, images
        # all states except rejected: an object is not background, even if its state was not chosen
        existing = project.labels.select(states=NOT_REJECTED, recordings=choose.recordings, classes=choose.classes)
        self._with_object = {entry.frame_id for entry in existing}
        waiting = [entry for entry in existing if entry.label.state is ReviewState.PROPOSED]
        self._open = set() if ReviewState.PROPOSED in states else {entry.frame_id for entry in waiting}

    def is_exported(self, frame: StoredFrame, losses: Losses) -> bool:
        """True if this frame's image is exported; counts a loss if only unreviewed proposals prevent it."""
        drawn = self._images.get(frame.id)
        if drawn is not None:
            return _is_drawn(drawn.boxes, self._choose)
        if frame.id in self._open:
            losses.add(Lost.OPEN, int(frame.id in self._labels))
            return False
        if frame.id in self._labels:
            return True
        if frame.id in self._with_object:
            return False
        return frame.index is not None and (frame.finalised or self._choose.empty_frames)
