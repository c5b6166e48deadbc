"""Writes pseudo-views as images, to be labelled with any 2D tool and imported again as COCO.

This takes two rounds: the first step's views come from the boxes on camera images, the second step's views from the
boxes drawn on the first step's. `views.json` beside the images holds the geometry of each, which the import needs to
interpret the boxes.

Detectors must not learn from withdrawn labels. So the image box is removed with the label drawn from it, and the boxes
on pseudo-views are removed with their image box.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from annotator.files import new_folder
from annotator.formats.coco import CocoImage, write_coco
from annotator.project import Project, StoredFrame, ViewBoxes
from annotator.project.log.event_types import (
    ImageBoxesSet,
    LabelAccepted,
    LabelDeleted,
    LabelEdited,
    LabelRejected,
    Payload,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.project.overview import FramePage
from annotator.rcv.axes import frame_with_normals
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import first_views, next_views
from annotator.types import Box2D, Frame, PseudoView, ReviewState
from annotator.types.errors import ConfigError, FormatError, FrameError
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.views.pairs import (
    ViewPlace,
    front_and_side,
    geometry_of,
    spans_m,
    views_by_object,
    write_places,
)

COCO = "coco.json"


@dataclass(frozen=True)
class WrittenViews:
    """Number of images written, and the labelled frames that could not be read, as `key: reason`."""

    pictures: int
    unreadable: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Drawn:
    stored: StoredFrame
    number: int
    step: int
    image_box: Box2D
    views: tuple[PseudoView, PseudoView]


def write_views(project: Project, out: Path, step: int, config: RcvConfig) -> WrittenViews:
    """Writes the pseudo-views of one step for every object that has the boxes it needs. The folder is written whole or
    not at all.

    Args:
        out: a new folder for PNG images, `views.json`, and a `coco.json` that lists the images without boxes.
        step: 1 (from the boxes on camera images) or 2 (from those on the first step's views).

    Raises:
        ConfigError: the folder exists, there is no such step, or no object has the boxes it needs.
        FormatError: the folder cannot be written.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise ConfigError(f"{out}: exists already; choose a new folder for the images")
    if step not in (1, 2):
        raise ConfigError(f"there is no step {step}; choose 1 or 2")
    frames = _Frames(project, config)
    images: list[CocoImage] = []
    places: list[ViewPlace] = []
    with new_folder(out, lambda _: False) as folder:
        for drawn in _first(frames) if step == 1 else _second(frames):
            for side, view in zip(("front", "side"), drawn.views, strict=True):
                place = _place(frames, drawn, side, view)
                _write_image(folder / place.file_name, view)
                images.append(CocoImage(place.file_name, view.rgb.shape[1], view.rgb.shape[0], ()))
                places.append(place)
        if not images:
            needed = "boxes on camera images" if step == 1 else "boxes on both views of the first step"
            unreadable = "".join(f"\n  unreadable: {line}" for line in frames.unreadable)
            raise ConfigError(f"project {project.config.name} has no object with {needed} yet{unreadable}")
        write_places(folder, places)
        write_coco(folder / COCO, images, project.config.classes)
    return WrittenViews(len(images), tuple(frames.unreadable))


def _place(frames: _Frames, drawn: _Drawn, side: str, view: PseudoView) -> ViewPlace:
    recording = frames.source.stored(drawn.stored.recording_id).name
    stem = re.sub(r"[^\w.-]+", "_", f"{recording}_{drawn.stored.key}_{drawn.number:02d}_step{drawn.step}_{side}")
    return ViewPlace(
        file_name=f"{stem}.png",
        recording=recording,
        frame=drawn.stored.key,
        step=drawn.step - 1,
        geometry=geometry_of(view, drawn.image_box),
    )


def _write_image(path: Path, view: PseudoView) -> None:
    _, data = cv2.imencode(".png", np.ascontiguousarray(view.rgb[:, :, ::-1]))
    try:
        path.write_bytes(data.tobytes())
    except OSError as error:
        raise FormatError(path, f"cannot be written ({error.strerror}); no files were kept") from error


class _Frames:
    """Reads labelled frames, and collects the errors of those that cannot be read."""

    def __init__(self, project: Project, config: RcvConfig) -> None:
        self.project, self.config = project, config
        self.source = FrameSource(project)
        self.unreadable: list[str] = []

    def read(self, frame_id: int) -> tuple[StoredFrame, Frame, RcvConfig] | None:
        """Returns a frame with the settings for its views; None if it cannot be read."""
        stored = self.project.frames.get(frame_id)
        try:
            frame = self.source.read(stored)
        except FrameError as error:
            self.unreadable.append(f"{stored.key}: {error}")
            return None
        orientation = orientation_for(self.project.config.settings.rotation, frame)
        return stored, frame, self.config.model_copy(update={"orientation": orientation})


def _first(frames: _Frames) -> Iterator[_Drawn]:
    for boxes in frames.project.boxes.on_images():
        read = frames.read(boxes.frame_id) if boxes.boxes else None
        if read is None:
            continue
        stored, frame, settings = read
        for number, box in enumerate(boxes.boxes):
            views = first_views(frame, box, settings)
            if views is not None:
                yield _Drawn(stored, number, 1, box, views)


def _second(frames: _Frames) -> Iterator[_Drawn]:
    by_frame: dict[int, list[tuple[Box2D, tuple[ViewBoxes, ViewBoxes]]]] = defaultdict(list)
    for (frame_id, image_box), steps in views_by_object(frames.project.boxes.on_views()).items():
        pair = front_and_side(steps[0])
        if pair is not None:
            by_frame[frame_id].append((image_box, pair))
    for frame_id, objects in by_frame.items():
        read = frames.read(frame_id)
        if read is None:
            continue
        stored, frame, settings = read
        frame = frame_with_normals(frame, [image_box for image_box, _ in objects], settings)
        for number, (image_box, pair) in enumerate(objects):
            spans = [(np.array(v.geometry.axes), spans_m(v)) for v in pair if v.geometry is not None]
            following = next_views(frame, image_box, spans, settings)
            if following is not None:
                yield _Drawn(stored, number, 2, image_box, following)


def image_follower(page: FramePage, payloads: Sequence[Payload]) -> ImageBoxesSet | None:
    """Returns the boxes on the image after a review of labels; None if they do not change.

    A drawn label that is deleted or rejected removes its box on the image. A rejected label that is accepted or edited
    restores it, so that detectors do not learn the object as background.

    Args:
        page: the frame before the change.
        payloads: the changes to its labels.
    """
    if page.image_boxes is None:
        return None
    drawn = {stored.label.uid: stored for stored in page.labels if stored.image_box is not None}
    boxes = list(page.image_boxes.boxes)
    for payload in payloads:
        match payload:
            case LabelDeleted(uid=uid) | LabelRejected(uid=uid) if uid in drawn:
                boxes = [box for box in boxes if box != drawn[uid].image_box]
            case LabelAccepted(uid=uid) | LabelEdited(uid=uid) if uid in drawn:
                box = drawn[uid].image_box
                if box is not None and box not in boxes and drawn[uid].label.state is ReviewState.REJECTED:
                    boxes.append(box)
    if boxes == list(page.image_boxes.boxes):
        return None
    return ImageBoxesSet(boxes=tuple(boxes), box_kind=page.image_boxes.box_kind)


def changes_kind(page: FramePage, on_image: ImageBoxesSet) -> bool:
    """Returns True if `on_image` changes the box kind of the frame."""
    return page.image_boxes is not None and page.image_boxes.box_kind is not on_image.box_kind


def view_followers(
    page: FramePage, on_image: ImageBoxesSet, *, redrawn: Box2D | None = None, kept: Collection[str] = ()
) -> list[Payload]:
    """Returns the events that keep the boxes on views consistent with those on the image.

    Boxes on views are removed with their image box, since the views are no longer a step of any object. If the box kind
    of the frame changes, that of the views changes as well.

    Args:
        page: the frame before the change.
        on_image: the new boxes on the image.
        redrawn: the image box of an object that is being stored: all its views except `kept` are removed.
        kept: ids of views that are not changed.
    """
    events: list[Payload] = []
    for (_, image_box), steps in views_by_object(page.view_boxes).items():
        is_gone = image_box not in on_image.boxes or image_box == redrawn
        for view in (view for views in steps.values() for view in views if view.view_id not in kept):
            if is_gone:
                events.append(ViewBoxesRemoved(view=view.view_id))
            elif changes_kind(page, on_image) and view.box_kind is not on_image.box_kind:
                events.append(
                    ViewBoxesSet(
                        view=view.view_id,
                        boxes=view.boxes,
                        box_kind=on_image.box_kind,
                        step=view.step,
                        geometry=view.geometry,
                    )
                )
    return events
