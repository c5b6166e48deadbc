"""The simulated operator confirms whole boxes of the objects that it has drawn as they are seen.

For each object it looks at the offered boxes one after the other, as a person would, and confirms the one that fits
best if its IoU with the true box is at least `FITS_IOU`. It never corrects a box. A person sees on the camera image, on
the views and in the 3D view whether a box fits; the true box stands for that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from annotator.geometry.iou import iou_3d
from annotator.project import NewLabel, Origin, Project, WriteContext
from annotator.types import BoxKind, Source
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.simulate import AUTHOR, image_box_of, visible_objects
from annotator.workflows.workbench.loaded_detectors import ready_view
from annotator.workflows.workbench.whole_boxes import WholeBoxes

# Boxes with at least this IoU fit, as in the review of the demo.
FITS_IOU = 0.5


@dataclass(frozen=True)
class Confirmed:
    """What the simulated operator did.

    Attributes:
        objects: drawn objects for which whole boxes were offered.
        confirmed: objects of which one was confirmed.
        actions: keys pressed: one for each further box looked at, and one to confirm.
        mean_iou: of the confirmed boxes with the true ones; NaN without any.
    """

    objects: int
    confirmed: int
    actions: int
    mean_iou: float


def confirm_whole_boxes(
    project: Project, recording_id: int, progress: Callable[[int, int], None] | None = None
) -> Confirmed:
    """Confirms whole boxes in the frames of a recording, once all of them are drawn; objects with a label are left out.

    Args:
        progress: called with (frames done, frames with drawn objects).

    Raises:
        RecordingError: the recording has no truth, or cannot be read.
        FrameError: a frame cannot be read; those before it are done.
        DetectionError, FormatError: the view detector cannot be loaded.
    """
    source, offers, detector = FrameSource(project), WholeBoxes(project), ready_view(project)
    recording = source.recording(recording_id)
    indices = {key: index for index, key in enumerate(recording.keys)}
    labelled = project.boxes.frames_with_images()
    frames = [one for one in project.frames.of([recording_id]) if one.index is not None and one.id in labelled]
    known = {(label.frame_id, label.image_box) for label in project.labels.select(recordings=[recording_id])}
    objects = actions = 0
    ious: list[float] = []
    for number, stored in enumerate(frames, 1):
        frame = source.read(stored)
        new = []
        for item in visible_objects(recording, indices[stored.key], frame, project.config.classes):
            image_box = image_box_of(frame, item, BoxKind.SILHOUETTE)
            if image_box is None or (stored.id, image_box) in known:
                continue
            offered = offers.of(frame, stored, image_box, detector)
            fits = [iou_3d(item.box, one.box) for one in offered]
            objects += bool(fits)
            actions += max(len(fits) - 1, 0)
            if fits and max(fits) >= FITS_IOU:
                box = offered[fits.index(max(fits))].box
                new.append(NewLabel(item.label, box, origin=Origin.DRAWN, image_box=image_box))
                ious.append(max(fits))
        if new:
            revision = project.frames.get(stored.id).revision
            project.labels.create(stored.id, new, WriteContext(revision, AUTHOR, Source.MANUAL))
        if progress is not None:
            progress(number, len(frames))
    mean = sum(ious) / len(ious) if ious else float("nan")
    return Confirmed(objects, len(ious), actions + len(ious), mean)
