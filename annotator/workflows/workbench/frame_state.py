"""A frame as the page shows it: labels with their outlines, and drawn objects; and a bag before it is
added: its topics, and the cloud of its first frame over the image.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from annotator.geometry.outline import sizes_on_image
from annotator.geometry.projection import inside_image, project
from annotator.image_bytes import encoded_image
from annotator.project import Project, ViewBoxes
from annotator.project.overview import FramePage
from annotator.recordings import ReaderOptions, open_recording
from annotator.recordings.ros.topics import TopicReport
from annotator.types import Box2D, Frame
from annotator.types.errors import AnnotatorError, InputError, MissingExtraError
from annotator.workflows.inspect import bag_topics
from annotator.workflows.views import ObjectViews, front_and_side, views_by_object
from annotator.workflows.workbench.frame_cache import FrameCache

# A camera sees an object much better than another one if it is larger by this factor (`sizes_on_image`).
MUCH_BETTER = 1.5


@dataclass(frozen=True, eq=False)
class ShownObject:
    """An object drawn with 2D boxes, finished or not.

    Attributes:
        views: the drawn views: front and side of each step.
        uid: of the object's label, or None while it is unfinished.
    """

    image_box: Box2D
    views: tuple[ViewBoxes, ...]
    uid: str | None


@dataclass(frozen=True)
class Sight:
    """Which cameras of a rig see an object.

    Attributes:
        frames: of the moment's cameras that see it, the best first.
        better: the first of them, if the camera that is shown sees the object not at all, or much worse.
    """

    frames: tuple[int, ...] = ()
    better: int | None = None


def sights(project: Project, frames: FrameCache, page: FramePage) -> dict[str, Sight]:
    """Returns which cameras see the objects of a moment, by uid; without a rig, nothing."""
    if len(page.cameras) < 2:
        return {}
    sizes: dict[str, dict[int, float]] = {stored.label.uid: {} for stored in page.labels}
    for frame_id in page.cameras.values():
        # a camera that cannot be read sees nothing
        with suppress(AnnotatorError):
            camera, labels = frames.camera(project, frame_id), project.labels.of_moment(frame_id)
            for stored, size in zip(labels, sizes_on_image(camera, [each.label.box for each in labels]), strict=True):
                if size > 0 and stored.label.uid in sizes:
                    sizes[stored.label.uid][frame_id] = float(size)
    return {uid: _sight(of_label, page.frame.id) for uid, of_label in sizes.items()}


def _sight(sizes: Mapping[int, float], shown: int) -> Sight:
    ordered = tuple(sorted(sizes, key=lambda frame_id: -sizes[frame_id]))
    is_better = bool(ordered) and sizes[ordered[0]] > MUCH_BETTER * sizes.get(shown, 0.0)
    return Sight(ordered, ordered[0] if is_better else None)


def shown_objects(page: FramePage) -> tuple[ShownObject, ...]:
    """Returns the drawn objects of a frame, finished or not, in the order of their boxes on the image."""
    if page.image_boxes is None:
        return ()
    views = views_by_object(page.view_boxes)
    uids = {stored.image_box: stored.label.uid for stored in page.drawn}
    return tuple(
        ShownObject(box, _views_of(page.frame.id, box, views), uids.get(box))
        for box in dict.fromkeys(page.image_boxes.boxes)
    )


def _views_of(frame_id: int, image_box: Box2D, views: ObjectViews) -> tuple[ViewBoxes, ...]:
    """Returns front and side of the first step, then of the second, each as drawn last."""
    pairs: list[ViewBoxes] = []
    for _, drawn in sorted(views.get((frame_id, image_box), {}).items()):
        pair = front_and_side(drawn)
        if pair is None:
            # only one view of this step is drawn, so there is no later step
            return (*pairs, drawn[-1])
        pairs.extend(pair)
    return tuple(pairs)


WIDTH_PX = 640
JPEG_QUALITY = 80
NEAREST_M = 0.05


@dataclass(frozen=True)
class BagPreview:
    """A bag as it would be read.

    Attributes:
        frames: their number; 0 if it cannot be read.
        notes: what the reader says about it.
        problem: why it cannot be read, and what to choose; "" if it can.
        picture: the first frame with its points, as a `data:` URL; "" if it cannot be read.
    """

    topics: tuple[TopicReport, ...]
    frames: int
    notes: tuple[str, ...]
    problem: str
    picture: str


def preview_bag(path: Path, options: ReaderOptions) -> BagPreview:
    """Opens a bag and draws its first frame."""
    topics = bag_topics(path, options)
    try:
        recording = open_recording(path, options)
        picture = f"data:image/jpeg;base64,{base64.b64encode(_drawn(recording.frame(0))).decode()}"
    except MissingExtraError:
        raise
    except InputError as error:
        return BagPreview(topics, 0, (), str(error), "")
    return BagPreview(topics, len(recording), recording.notes, "", picture)


def _drawn(frame: Frame) -> bytes:
    """Returns the image with the points of the cloud, near ones red, as a JPEG file."""
    import cv2

    scale = min(WIDTH_PX / frame.camera.width_px, 1.0)
    size = (max(round(frame.camera.width_px * scale), 1), max(round(frame.camera.height_px * scale), 1))
    picture = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
    xyz_m = frame.cloud.xyz_m[frame.cloud.xyz_m[:, 2] > NEAREST_M]
    px = project(frame.camera, xyz_m)
    seen = np.flatnonzero(inside_image(frame.camera, px))
    # near points last, so that they are visible
    seen = seen[np.argsort(-xyz_m[seen, 2], kind="stable")]
    column, row = np.floor((px[seen] + 0.5) * scale).astype(np.int64).T
    near = np.linspace(0, 255, len(seen)).astype(np.uint8)
    colors = cv2.applyColorMap(near[:, None], cv2.COLORMAP_JET)[:, 0, ::-1]
    picture[np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)] = colors
    return encoded_image(picture, "jpg", JPEG_QUALITY)
