"""A simulated operator: labels a recording from its truth with five 2D boxes per object, as a person would.

The operator `silhouette` draws around the object's visible points, as a person does. The operator `box` stands for
imported 3D labels (RCV paper, Fig. 5): it projects the true box onto the same images and views, and stores it as an
imported 3D label. `silhouette` also works for recordings with masks but no boxes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import aligned_box, contains
from annotator.geometry.outline import box_on_image, points_on_image
from annotator.geometry.projection import project
from annotator.project import REVIEWED, NewLabel, Project, StoredFrame, WriteContext
from annotator.rcv.axes import frame_with_normals
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import DrawnObject, draw_object
from annotator.rcv.teach import TaughtObject, project_box, span_on_view
from annotator.recordings import Recording
from annotator.types import Box2D, BoxKind, Frame, PseudoView, Source, Truth
from annotator.types.errors import ConfigError
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.recorded.reading import has_masks, has_truth, is_labelled, load_mask, load_truth
from annotator.workflows.views import geometry_of

AUTHOR = "simulated operator"
# Objects with fewer points are too hard to see.
MIN_VISIBLE_POINTS = 20
# 3D IoU from which a true box is the same as a label of the frame, up to rounding. Such a box is not imported again.
SAME_BOX_IOU = 0.99


@dataclass(frozen=True)
class Drawn:
    """Counts of the simulated operator's work.

    Attributes:
        frames: labelled frames.
        objects: objects with all five boxes.
        boxes: all 2D boxes drawn.
    """

    frames: int
    objects: int
    boxes: int


def visible_objects(recording: Recording, index: int, frame: Frame, classes: Sequence[str]) -> list[TaughtObject]:
    """Returns the true objects of the given classes that have enough points, with a mask of their points.

    If the recording has masks but no boxes, the objects are those of the mask, of the project's only class, with the
    axis-aligned box around their points.
    """
    mask = load_mask(recording, frame)
    if mask is not None and has_masks(recording) and not has_truth(recording):
        if len(classes) != 1:
            raise ConfigError(
                f"{recording.path}: has masks but no true boxes, so the class of an object ({', '.join(classes)}) is "
                "unknown; use a project with one class, or add a boxes.json"
            )
        return _masked_objects(frame, mask, classes[0])
    # the numbers of the mask count all labelled objects, those of other classes included
    objects = [
        TaughtObject(t.label, t.box, _own_points(t, number, frame, mask))
        for number, t in enumerate(load_truth(recording, index, frame), 1)
        if t.label in classes
    ]
    return [o for o in objects if o.points is not None and o.points.sum() >= MIN_VISIBLE_POINTS]


def require_boxes_for(kind: BoxKind, recording: Recording) -> None:
    """Checks that the recording has true boxes if the operator needs them."""
    if kind is BoxKind.BOX and has_masks(recording) and not has_truth(recording):
        raise ConfigError(
            f"{recording.path}: the operator `box` needs true boxes, but the recording has only masks; "
            "use the operator `silhouette`, or add a boxes.json"
        )


def _masked_objects(frame: Frame, mask: np.ndarray, label: str) -> list[TaughtObject]:
    pixel = _pixel_of_points(frame)
    assert pixel is not None  # has_masks
    number_of_point = mask.ravel()[pixel]
    numbers, counts = np.unique(number_of_point, return_counts=True)
    objects = []
    for number in numbers[(numbers > 0) & (counts >= MIN_VISIBLE_POINTS)]:
        is_object = number_of_point == number
        objects.append(TaughtObject(label, aligned_box(frame.cloud.xyz_m[is_object], np.eye(3)), is_object))
    return objects


def _own_points(truth: Truth, number: int, frame: Frame, mask: np.ndarray | None) -> np.ndarray:
    """Returns the mask of the object's points: from the image mask if there is one, else those in its true box."""
    pixel = None if mask is None else _pixel_of_points(frame)
    if mask is None or pixel is None:
        return contains(truth.box, frame.cloud.xyz_m)
    return mask.ravel()[pixel] == number


def _pixel_of_points(frame: Frame) -> np.ndarray | None:
    """Returns the image's pixel that each point is seen in, `v * width + u`; None for a LiDAR."""
    if frame.depth_m is None or frame.cloud.pixel_index is not None:
        return frame.cloud.pixel_index
    # a depth camera beside the colour camera, whose points all lie in the image
    size = np.array([frame.camera.width_px, frame.camera.height_px])
    u, v = np.floor(project(frame.camera, frame.cloud.xyz_m) + 0.5).astype(np.int64).clip(0, size - 1).T
    return np.asarray(v * frame.camera.width_px + u)


def draw_frame(
    frame: Frame, objects: Sequence[TaughtObject], kind: BoxKind, config: RcvConfig
) -> tuple[list[Box2D], list[DrawnObject]]:
    """Returns the boxes on the image, and the objects with boxes on all four views."""
    visible = [(item, box) for item in objects if (box := image_box_of(frame, item, kind)) is not None]
    on_image = [box for _, box in visible]
    frame = frame_with_normals(frame, on_image)
    finished: list[DrawnObject] = []
    for item, image_box in visible:
        drawn = draw_object(frame, image_box, partial(_draw, frame=frame, item=item, kind=kind), config)
        if drawn is not None:
            finished.append(drawn)
    return on_image, finished


def image_box_of(frame: Frame, item: TaughtObject, kind: BoxKind) -> Box2D | None:
    """The box that the simulated operator draws around an object on the camera image; None if it is not visible."""
    if kind is BoxKind.BOX:
        return box_on_image(frame.camera, item.box, item.label)
    return points_on_image(frame.camera, frame.cloud.xyz_m[item.points], item.label)


def _draw(view: PseudoView, frame: Frame, item: TaughtObject, kind: BoxKind) -> Box2D | None:
    if kind is BoxKind.BOX:
        return project_box(view, item.box, item.label)
    xyz_m = frame.cloud.xyz_m[item.points]
    visible = xyz_m[_is_inside(view, xyz_m)]
    return span_on_view(view, visible, item.label) if len(visible) > 1 else None


def _is_inside(view: PseudoView, xyz_m: np.ndarray) -> np.ndarray:
    # the origin is the centre of the first pixel; the view begins half a pixel before it
    low = view.origin_m - view.metres_per_px / 2
    high = low + view.extent_m
    xy_m = xyz_m @ view.axes[:2].T
    return ((xy_m >= low) & (xy_m <= high)).all(axis=1)


def simulate_recording(
    project: Project,
    recording_id: int,
    kind: BoxKind,
    config: RcvConfig,
    every: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Drawn:
    """Labels every `every`-th frame of a recording from its truth, and stores the boxes like an operator's.

    A repeated run replaces the drawn boxes and does not import a 3D box twice. Frames that are no longer in the
    recording are skipped.

    Args:
        config: how pseudo-views are drawn; its orientation is set for each frame from the project's rotation.
    """
    if every < 1:
        raise ConfigError(f"cannot label every {every} frames; give 1 or more")
    source = FrameSource(project)
    recording = source.recording(recording_id)
    require_boxes_for(kind, recording)
    settings = project.config
    present = [stored for stored in project.frames.of([recording_id]) if stored.index is not None]
    frames = [stored for stored in present if is_labelled(recording, stored.key)][::every]
    drawn_objects = boxes = 0
    for number, stored in enumerate(frames, 1):
        frame = source.read(stored)
        orientation = orientation_for(settings.settings.rotation, frame)
        frame_config = config.model_copy(update={"orientation": orientation})
        objects = visible_objects(recording, recording.indices[stored.key], frame, settings.classes)
        on_image, finished = draw_frame(frame, objects, kind, frame_config)
        revision = _store(project, stored, on_image, finished, kind)
        if kind is BoxKind.BOX and objects:
            _import_boxes(project, stored.id, objects, WriteContext(revision, AUTHOR, Source.IMPORTED))
        drawn_objects += len(finished)
        boxes += len(on_image) + sum(len(drawn.views) for drawn in finished)
        if progress is not None:
            progress(number, len(frames))
    if boxes == 0:
        raise ConfigError(
            f"{recording.path}: has no masks and no visible true boxes of {', '.join(settings.classes)}, so nothing "
            "can be simulated; draw boxes in the browser, or import them: annotator import"
        )
    return Drawn(len(frames), drawn_objects, boxes)


def _store(
    project: Project,
    stored: StoredFrame,
    on_image: Sequence[Box2D],
    finished: Sequence[DrawnObject],
    kind: BoxKind,
) -> int:
    """Stores the drawn boxes; returns the frame's new revision."""
    context = WriteContext(stored.revision, AUTHOR, Source.MANUAL)
    revision = project.boxes.set_on_image(stored.id, on_image, kind, context).revision
    for drawn in finished:
        for item in drawn.views:
            revision = project.boxes.set_on_view(
                project.views.store(item.view.rgb),
                [item.box],
                kind,
                WriteContext(revision, AUTHOR, Source.MANUAL),
                frame_id=stored.id,
                step=item.step,
                geometry=geometry_of(item.view, drawn.image_box),
            ).revision
    return revision


def _import_boxes(project: Project, frame_id: int, objects: Sequence[TaughtObject], context: WriteContext) -> None:
    known = [label for label in project.labels.of_frame(frame_id) if label.state in REVIEWED]
    new = [
        NewLabel(item.label, item.box)
        for item in objects
        if not any(label.label == item.label and iou_3d(label.box, item.box) >= SAME_BOX_IOU for label in known)
    ]
    if new:
        project.labels.create(frame_id, new, context)
