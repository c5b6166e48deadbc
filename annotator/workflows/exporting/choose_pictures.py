"""Which pictures of a project leave in a format of 2D boxes, and with which boxes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

from annotator.formats.losses import Losses, Lost
from annotator.project import ImageBoxes, Project, StoredFrame, StoredLabel, ViewBoxes
from annotator.types import Box2D, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.exporting.choose import Chosen, ExportFilter, divided, labels_by_frame
from annotator.workflows.exporting.split import Split
from annotator.workflows.exporting.table import NOT_REJECTED

Pictures = Literal["images", "views", "both"]


@dataclass(frozen=True, eq=False)
class ChosenPictures(Chosen):
    """The pictures of one frame that leave.

    Attributes:
        image: whether the camera image does.
        drawn: the boxes drawn on it; the frame's labels that are not among them are projected onto it.
        views: drawn pseudo-views of the frame.
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
    """The frames whose pictures leave, in the project's order.

    A camera image leaves with the boxes drawn on it, and the outlines of those labels of the frame that are not drawn.
    One that shows nothing is a background picture if somebody said so: drawn on, and empty, or finalised without a
    label in any state but rejected. An image some of whose objects wait for a review, none of them drawn, would call
    these background: it stays.

    Args:
        states: of the labels that leave.
        losses: told of the images that stay.

    Raises:
        ConfigError: the project has no such class, no picture fits, or there are too few frames for a part.
    """
    labels = labels_by_frame(project, choose, states)
    images = {b.frame_id: b for b in project.boxes.on_images(choose.recordings)} if pictures != "views" else {}
    views = _views_by_frame(project, choose) if pictures != "images" else {}
    leaving = _Images(project, choose, states, labels, images) if pictures != "views" else None
    frames: list[StoredFrame] = []
    with_image: set[int] = set()
    for frame in project.frames.of(choose.recordings):
        if leaving is not None and leaving.leaves(frame, losses):
            with_image.add(frame.id)
        if frame.id in with_image or frame.id in views:
            frames.append(frame)
    if not frames and not loose_views(project, choose, pictures):
        raise ConfigError(
            f"project {project.config.name} has no labelled {'picture' if pictures == 'both' else pictures} to export; "
            "draw boxes, or review proposals (`annotator serve`)"
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
    """Drawn pseudo-views that belong to no frame: brought from elsewhere, only to learn from."""
    if pictures == "images" or choose.recordings is not None:
        return []
    return [view for view in project.boxes.on_views() if view.frame_id is None and _is_drawn(view.boxes, choose)]


def wanted(boxes: Sequence[Box2D], classes: Collection[str] | None) -> list[Box2D]:
    """Those of the wanted classes; None = all."""
    return [box for box in boxes if classes is None or box.label in classes]


def _is_drawn(boxes: Sequence[Box2D], choose: ExportFilter) -> bool:
    """True for a picture with a wanted box, or one that is said to show nothing."""
    return not boxes or choose.empty_frames or bool(wanted(boxes, choose.classes))


def _views_by_frame(project: Project, choose: ExportFilter) -> dict[int, list[ViewBoxes]]:
    views: dict[int, list[ViewBoxes]] = defaultdict(list)
    for view in project.boxes.on_views():
        if view.frame_id is not None and _is_drawn(view.boxes, choose):
            views[view.frame_id].append(view)
    return views


class _Images:
    """Decides which camera images leave."""

    def __init__(
        self,
        project: Project,
        choose: ExportFilter,
        states: tuple[ReviewState, ...],
        labels: dict[int, tuple[StoredLabel, ...]],
        images: dict[int, ImageBoxes],
    ) -> None:
        self._choose, self._labels, self._images = choose, labels, images
        # whatever leaves: an object in a state that nobody asked for is no background, either
        there = project.labels.select(states=NOT_REJECTED, recordings=choose.recordings, classes=choose.classes)
        self._with_object = {entry.frame_id for entry in there}
        waiting = [entry for entry in there if entry.label.state is ReviewState.PROPOSED]
        self._open = set() if ReviewState.PROPOSED in states else {entry.frame_id for entry in waiting}

    def leaves(self, frame: StoredFrame, losses: Losses) -> bool:
        """Whether this frame's image does; counts it where only open proposals keep it back."""
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
