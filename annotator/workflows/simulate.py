"""A simulated operator: labels a recording from its truth exactly as a person would with a mouse, five boxes an object.

`silhouette` draws around the object's visible points, as a person does. `box` stands for a folder whose 3D labels are
imported (RCV paper, Fig. 5): the true box is projected onto the same pictures, and kept as an imported 3D label.
A recording with masks but no boxes can be drawn around, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from annotator.geometry.fit import aligned_box
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import contains
from annotator.geometry.outline import box_on_image, points_on_image
from annotator.project import REVIEWED, Change, NewLabel, Project, StoredFrame
from annotator.rcv.config import RcvConfig
from annotator.rcv.normals import frame_with_normals
from annotator.rcv.operator import DrawnObject, draw_object
from annotator.rcv.teach import TaughtObject, project_box, span_on_view
from annotator.recordings import Recording
from annotator.types import Box2D, BoxKind, Frame, PointCloud, PseudoView, Source, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.frames import FrameSource, orientation_for
from annotator.workflows.truth import has_masks, has_truth, load_mask, load_truth
from annotator.workflows.views_out import geometry_of

AUTHOR = "simulated operator"
# An operator cannot see an object of fewer points.
MIN_VISIBLE_POINTS = 20
# A true box that the frame has as a label already, up to rounding, is not imported again.
SAME_BOX_IOU = 0.99


@dataclass(frozen=True)
class Drawn:
    """What the simulated operator did.

    Attributes:
        frames: labelled.
        objects: finished with all five boxes.
        boxes: 2D boxes drawn in all.
    """

    frames: int
    objects: int
    boxes: int


def visible_objects(recording: Recording, index: int, frame: Frame, classes: Sequence[str]) -> list[TaughtObject]:
    """The true objects of the project's classes that have enough points, each with the points that are its own.

    Where the recording has masks but no boxes, the objects are those that the mask numbers, of the project's only
    class; what encloses their points stands in for a true box then.

    Raises:
        RecordingError: the recording has neither boxes nor masks.
        ConfigError: masks only, and the project has several classes.
        FormatError: broken boxes, or a broken or missing mask.
    """
    mask = load_mask(recording, frame)
    if mask is not None and has_masks(recording) and not has_truth(recording):
        return _masked_objects(frame, mask, only_class(recording, classes))
    # The mask numbers all labelled objects, those of other classes included.
    objects = [
        TaughtObject(t.label, t.box, _own_points(t, number, frame.cloud, mask))
        for number, t in enumerate(load_truth(recording, index, frame), 1)
        if t.label in classes
    ]
    return [o for o in objects if o.points is not None and o.points.sum() >= MIN_VISIBLE_POINTS]


def only_class(recording: Recording, classes: Sequence[str]) -> str:
    """The class of everything in masks that come without boxes.

    Raises:
        ConfigError: there are several to choose from.
    """
    if len(classes) != 1:
        raise ConfigError(
            f"{recording.path}: has masks but no true boxes, so nothing says which of {', '.join(classes)} an object "
            "is; use a project with one class, or add a boxes.json"
        )
    return classes[0]


def require_boxes_for(kind: BoxKind, recording: Recording) -> None:
    """Refuses to draw true boxes where there are only masks.

    Raises:
        ConfigError: so it is.
    """
    if kind is BoxKind.BOX and has_masks(recording) and not has_truth(recording):
        raise ConfigError(
            f"{recording.path}: the operator `box` needs true boxes, and there are only masks; "
            "use the operator `silhouette`, or add a boxes.json"
        )


def _masked_objects(frame: Frame, mask: np.ndarray, label: str) -> list[TaughtObject]:
    assert frame.cloud.pixel_index is not None  # has_masks
    number_of_point = mask.ravel()[frame.cloud.pixel_index]
    numbers, counts = np.unique(number_of_point, return_counts=True)
    objects = []
    for number in numbers[(numbers > 0) & (counts >= MIN_VISIBLE_POINTS)]:
        own = number_of_point == number
        objects.append(TaughtObject(label, aligned_box(frame.cloud.xyz_m[own], np.eye(3)), own))
    return objects


def _own_points(truth: Truth, number: int, cloud: PointCloud, mask: np.ndarray | None) -> np.ndarray:
    """The object's points: by the mask where there is one, else those in its true box."""
    if mask is None or cloud.pixel_index is None:
        return contains(truth.box, cloud.xyz_m)
    return mask.ravel()[cloud.pixel_index] == number


def draw_frame(
    frame: Frame, objects: Sequence[TaughtObject], kind: BoxKind, config: RcvConfig
) -> tuple[list[Box2D], list[DrawnObject]]:
    """The boxes on the image, and the objects that could be finished."""
    seen = [(item, box) for item in objects if (box := _image_box(frame, item, kind)) is not None]
    on_image = [box for _, box in seen]
    frame = frame_with_normals(frame, on_image, config)
    finished: list[DrawnObject] = []
    for item, image_box in seen:
        drawn = draw_object(frame, image_box, partial(_draw, frame=frame, item=item, kind=kind), config)
        if drawn is not None:
            finished.append(drawn)
    return on_image, finished


def _image_box(frame: Frame, item: TaughtObject, kind: BoxKind) -> Box2D | None:
    if kind is BoxKind.BOX:
        return box_on_image(frame.camera, item.box, item.label)
    return points_on_image(frame.camera, frame.cloud.xyz_m[item.points], item.label)


def _draw(view: PseudoView, frame: Frame, item: TaughtObject, kind: BoxKind) -> Box2D | None:
    if kind is BoxKind.BOX:
        return project_box(view, item.box, item.label)
    shown = frame.cloud.xyz_m[item.points]
    seen = shown[_in_picture(view, shown)]
    return span_on_view(view, seen, item.label) if len(seen) > 1 else None


def _in_picture(view: PseudoView, xyz_m: np.ndarray) -> np.ndarray:
    # The origin is the centre of the first pixel; the picture begins half a pixel before it.
    low = view.origin_m - view.metres_per_px / 2
    high = low + view.extent_m
    seen = xyz_m @ view.axes[:2].T
    return ((seen >= low) & (seen <= high)).all(axis=1)


def simulate_recording(
    project: Project,
    recording_id: int,
    kind: BoxKind,
    config: RcvConfig,
    every: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Drawn:
    """Labels every so many frames of a recording from its truth; the store keeps it like an operator's work.

    Doing it again replaces the boxes that were drawn, and imports no 3D box twice. Frames that are no longer in the
    recording are passed by.

    Args:
        config: how pseudo-views are drawn; its orientation is set frame by frame from the project's setting.
        progress: called with (frames labelled, frames to label).

    Raises:
        ConfigError: `every` is less than 1, or the recording brings no truth of the project's classes; or it brings
            masks only, and true boxes shall be drawn or the project has several classes.
        RecordingError: it brings no truth at all, or cannot be read.
        FrameError: one of the frames cannot be read; those before it are labelled.
    """
    if every < 1:
        raise ConfigError(f"every {every} frames cannot be labelled; give 1 or more")
    source = FrameSource(project)
    recording = source.recording(recording_id)
    require_boxes_for(kind, recording)
    settings = project.config
    frames = [stored for stored in project.frames.of([recording_id]) if stored.index is not None][::every]
    places = {key: index for index, key in enumerate(recording.keys)}
    drawn_objects = boxes = 0
    for number, stored in enumerate(frames, 1):
        frame = source.read(stored)
        orientation = orientation_for(settings.settings.rotation, frame)
        turned = config.model_copy(update={"orientation": orientation})
        objects = visible_objects(recording, places[stored.key], frame, settings.classes)
        on_image, finished = draw_frame(frame, objects, kind, turned)
        revision = _store(project, stored, on_image, finished, kind)
        if kind is BoxKind.BOX and objects:
            _import_boxes(project, stored.id, objects, Change(revision, AUTHOR, Source.IMPORTED))
        drawn_objects += len(finished)
        boxes += len(on_image) + sum(len(drawn.views) for drawn in finished)
        if progress is not None:
            progress(number, len(frames))
    if boxes == 0:
        raise ConfigError(
            f"{recording.path}: brings no true boxes of {', '.join(settings.classes)} (nor masks of anything) that "
            "can be seen, so nothing can be simulated; "
            "draw boxes in the browser, or import them: annotator import"
        )
    return Drawn(len(frames), drawn_objects, boxes)


def _store(
    project: Project,
    stored: StoredFrame,
    on_image: Sequence[Box2D],
    finished: Sequence[DrawnObject],
    kind: BoxKind,
) -> int:
    """Puts the drawn boxes into the store; the frame's revision afterwards."""
    revision = stored.revision
    revision = project.boxes.set_on_image(stored.id, on_image, kind, Change(revision, AUTHOR, Source.MANUAL)).revision
    for drawn in finished:
        for item in drawn.views:
            revision = project.boxes.set_on_view(
                project.views.store(item.view.rgb),
                [item.box],
                kind,
                Change(revision, AUTHOR, Source.MANUAL),
                frame_id=stored.id,
                step=item.step,
                geometry=geometry_of(item.view, drawn.image_box),
            ).revision
    return revision


def _import_boxes(project: Project, frame_id: int, objects: Sequence[TaughtObject], change: Change) -> None:
    known = [label for label in project.labels.of_frame(frame_id) if label.state in REVIEWED]
    new = [
        NewLabel(item.label, item.box)
        for item in objects
        if not any(label.label == item.label and iou_3d(label.box, item.box) >= SAME_BOX_IOU for label in known)
    ]
    if new:
        project.labels.create(frame_id, new, change)
