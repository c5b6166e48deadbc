"""Pseudo-views as image files, and relations between the stored ones.

Views are written in two rounds, to be labelled with any 2D tool and imported again as COCO: the first step's come from
the boxes on camera images, the second step's from the boxes drawn on the first step's. `views.json` beside the images
holds the geometry of each, which the import needs.

Detectors must not learn from withdrawn labels. So the image box is removed with the label drawn from it, and the boxes
on pseudo-views are removed with their image box.

After a correction of a recording's calibration, its cloud has other colours, and a frustum holds other points. The
drawn boxes stay on their objects, because the views have moved with the cloud. So a picture is drawn anew in the window
that is stored, of the points that the view would show today.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from pydantic import TypeAdapter
from scipy.optimize import linear_sum_assignment

from annotator.files import TABLE_BYTES, new_folder, read_file
from annotator.formats.coco import write_coco
from annotator.formats.dataset_writing import writing
from annotator.formats.frame_names import PictureLabels
from annotator.formats.reading import faults, write_text
from annotator.geometry.iou import box_iou
from annotator.geometry.outline import MIN_SIDE_PX, box_on_image
from annotator.geometry.projection import in_frustum
from annotator.image_bytes import encoded_image
from annotator.project import Project, ViewBoxes, ViewGeometry
from annotator.project.changes import (
    ImageBoxesSet,
    LabelChanged,
    LabelDeleted,
    Payload,
    ViewBoxesRemoved,
    ViewBoxesSet,
)
from annotator.project.overview import FramePage
from annotator.project.records import Rotation3
from annotator.rcv.axes import frame_with_normals
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import first_views, next_views
from annotator.rcv.measure import make_pair
from annotator.rcv.pseudo_view import Window, drawn_points, render_window, side_axes
from annotator.rcv.recursion import cut_cloud
from annotator.rcv.teach import MIN_POINTS
from annotator.types import Box2D, Camera, Frame, Label, PointCloud, PseudoView, ReviewState
from annotator.types.bases import Strict
from annotator.types.errors import ConfigError, FrameError
from annotator.workflows.frame_source import FrameSource, orientation_for

SIDECAR = "views.json"


class ViewPlace(Strict):
    """The origin of a pseudo-view image.

    Attributes:
        file_name: of the image.
        recording, frame: its frame; None for an image from elsewhere, which is used for training only.
        step: of the recursion, from 0; None if unknown.
        geometry: the view's position and axes in space; None if unknown.
        labelled: True if it was reviewed: without boxes it then shows no object.
    """

    file_name: str
    recording: str | None
    frame: str | None
    step: int | None
    geometry: ViewGeometry | None
    labelled: bool = False


_PLACES: TypeAdapter[tuple[ViewPlace, ...]] = TypeAdapter(tuple[ViewPlace, ...])


def write_places(pictures: Path, places: Sequence[ViewPlace]) -> None:
    """Writes `views.json` into a folder of images."""
    write_text(pictures / SIDECAR, _PLACES.dump_json(tuple(places), indent=1).decode())


def read_places(pictures: Path) -> dict[str, ViewPlace]:
    """Reads `views.json` of a folder of images, by file name; empty if there is none."""
    file = pictures / SIDECAR
    if not file.is_file():
        return {}
    with faults(file, remedy="; write the views again"):
        return {place.file_name: place for place in _PLACES.validate_json(read_file(file, TABLE_BYTES))}


def geometry_of(view: PseudoView, image_box: Box2D) -> ViewGeometry:
    """Returns the geometry of a pseudo-view for the store.

    Args:
        image_box: the box on the camera image whose frustum the view shows.
    """
    return ViewGeometry.of(view).model_copy(update={"image_box": image_box})


def spans_m(view: ViewBoxes) -> np.ndarray:
    """Returns the span of the first box on a stored view, view coordinates in metres, (2, 2): rows x, y; columns low,
    high."""
    assert view.geometry is not None  # callers pass only views with known geometry
    box, scale = view.boxes[0], view.geometry.metres_per_px
    edges = np.array([[box.x_min, box.x_max], [box.y_min, box.y_max]])
    return np.array(view.geometry.origin_m)[:, None] + edges * scale


# Tolerance for axes that a file has rounded; the store returns them exactly.
SAME_AXES = 1e-6

ObjectViews = dict[tuple[int, Box2D], dict[int, list[ViewBoxes]]]


def views_by_object(views: Iterable[ViewBoxes]) -> ObjectViews:
    """Groups views with boxes and known geometry by (frame, image box), then by step."""
    grouped: ObjectViews = defaultdict(lambda: defaultdict(list))
    for view in views:
        image_box = None if view.geometry is None else view.geometry.image_box
        if view.frame_id is not None and view.step is not None and image_box is not None and view.boxes:
            grouped[view.frame_id, image_box][view.step].append(view)
    return grouped


def front_and_side(views: Sequence[ViewBoxes]) -> tuple[ViewBoxes, ViewBoxes] | None:
    """Returns the pair that was labelled last, front view first; None if no two views are a pair.

    Views may have been labelled in any order, and may include those of an earlier attempt.

    Args:
        views: of one object and step, in the order of their labelling.
    """
    for later in range(len(views) - 1, 0, -1):
        for earlier in range(later - 1, -1, -1):
            for front, side in ((views[earlier], views[later]), (views[later], views[earlier])):
                if front.geometry and side.geometry and _are_beside(front.geometry.axes, side.geometry.axes):
                    return front, side
    return None


@lru_cache(maxsize=1024)
def _are_beside(front: Rotation3, side: Rotation3) -> bool:
    return bool(np.allclose(side_axes(np.array(front)), side, atol=SAME_AXES))


# 2D IoU from which a drawn box and an outline of the same class belong to the same object. Low, because the drawn box
# of a half hidden object is much smaller than its outline.
SAME_IOU = 0.2


def outlines(camera: Camera, labels: Sequence[Label], min_side_px: float = MIN_SIDE_PX) -> dict[str, Box2D]:
    """Returns the image box of each label by uid; labels outside the image, or thinner on it, are left out."""
    pairs = [(label.uid, box_on_image(camera, label.box, label.label, min_side_px)) for label in labels]
    return {uid: box for uid, box in pairs if box is not None}


def undrawn(camera: Camera, labels: Sequence[Label], drawn: Sequence[Box2D]) -> dict[str, Box2D]:
    """Returns the outlines by uid of the labels without a drawn box, after matching drawn boxes one to one."""
    boxes = outlines(camera, labels)
    matched = drawn_of(boxes, drawn)
    return {uid: box for uid, box in boxes.items() if uid not in matched}


def drawn_of(boxes: Mapping[str, Box2D], drawn: Sequence[Box2D]) -> dict[str, int]:
    """Returns which drawn box belongs to an outline, by the outline's uid: those that overlap most, one to one."""
    if not boxes or not drawn:
        return {}
    uids = list(boxes)
    overlap = np.array([[box_iou(box, boxes[uid]) * (box.label == boxes[uid].label) for box in drawn] for uid in uids])
    rows, columns = linear_sum_assignment(overlap, maximize=True)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {uids[row]: column for row, column in pairs if overlap[row, column] >= SAME_IOU}


Steps = Mapping[int, Sequence[ViewBoxes]]
SizePx = Callable[[ViewBoxes], tuple[int, int]]


def redrawn(frame: Frame, view: ViewBoxes, steps: Steps, size_px: SizePx) -> UInt8[np.ndarray, "h w 3"] | None:
    """The picture that a stored view shows of a frame; None if its drawn boxes enclose hardly a point.

    Args:
        view: with geometry and image box.
        steps: all views of the same object, by step.
        size_px: gives the width and height of a view's picture.
    """
    geometry = view.geometry
    assert geometry is not None and geometry.image_box is not None
    frustum = frame.cloud.select(in_frustum(frame.camera, frame.cloud.xyz_m, geometry.image_box))
    width_px, height_px = size_px(view)
    axes, drawn = np.array(geometry.axes), frustum
    if view.step:
        drawn = _cut(frustum, steps, size_px)
        keep = drawn_points(len(drawn), max(width_px, height_px))
        drawn = drawn if keep is None else drawn.select(keep)
    if view.boxes:
        low, high = spans_m(view).T
        on_view = drawn.xyz_m @ axes[:2].T
        if np.count_nonzero(((on_view >= low) & (on_view <= high)).all(axis=1)) < MIN_POINTS:
            return None
    window = Window(np.array(geometry.origin_m), geometry.metres_per_px, width_px, height_px)
    return render_window(drawn, axes, window)


def _cut(frustum: PointCloud, steps: Steps, size_px: SizePx) -> PointCloud:
    """The points in the boxes of the first step, as in `rcv.known_objects.next_views`; all if these boxes are gone."""
    pair = front_and_side(steps.get(0, ()))
    if pair is None:
        return frustum
    views = [v.geometry.view(np.zeros((*size_px(v)[::-1], 3), np.uint8)) for v in pair if v.geometry is not None]
    front, side = (replace(view.boxes[0], score=1.0) for view in pair)
    return cut_cloud(frustum, make_pair(views, front, side).box, views)


COCO = "coco.json"


@dataclass(frozen=True)
class WrittenViews:
    """Number of images written, and the labelled frames that could not be read, as `key: reason`."""

    pictures: int
    unreadable: tuple[str, ...]


def write_views(project: Project, out: Path, step: int, config: RcvConfig) -> WrittenViews:
    """Writes the pseudo-views of one step for every object that has the boxes it needs. The folder is written whole or
    not at all.

    Args:
        out: a new folder for PNG images, `views.json`, and a `coco.json` that lists the images without boxes.
        step: 1 (from the boxes on camera images) or 2 (from those on the first step's views).
    """
    if step not in (1, 2):
        raise ConfigError(f"there is no step {step}; choose 1 or 2")
    images: list[PictureLabels] = []
    places: list[ViewPlace] = []
    broken: list[str] = []
    with new_folder(out, lambda _: False) as folder:
        for place, view in _places(project, step, config, broken):
            with writing(out):
                (folder / place.file_name).write_bytes(encoded_image(view.rgb))
            images.append(PictureLabels(place.file_name, (), (view.rgb.shape[1], view.rgb.shape[0])))
            places.append(place)
        if not images:
            needed = "boxes on camera images" if step == 1 else "boxes on both views of the first step"
            unreadable = "".join(f"\n  unreadable: {line}" for line in broken)
            raise ConfigError(f"project {project.config.name} has no object with {needed} yet{unreadable}")
        write_places(folder, places)
        write_coco(folder / COCO, images, project.config.classes)
    return WrittenViews(len(images), tuple(broken))


def _places(
    project: Project, step: int, config: RcvConfig, broken: list[str]
) -> Iterator[tuple[ViewPlace, PseudoView]]:
    """The pseudo-views of a step, in pairs; frames that cannot be read are added to `broken`."""
    source = FrameSource(project)
    for frame_id, objects in (_drawn_boxes(project) if step == 1 else _drawn_pairs(project)).items():
        stored = project.frames.get(frame_id)
        try:
            frame = source.read(stored)
        except FrameError as error:
            broken.append(f"{stored.key}: {error}")
            continue
        orientation = orientation_for(project.config.settings.rotation, frame)
        settings = config.model_copy(update={"orientation": orientation})
        if step == 2:
            frame = frame_with_normals(frame, [image_box for image_box, _ in objects])
        recording = project.recordings.get(stored.recording_id).name
        for number, (image_box, pair) in enumerate(objects):
            spans = [(np.array(v.geometry.axes), spans_m(v)) for v in pair if v.geometry is not None]
            views = next_views(frame, image_box, spans, settings) if spans else first_views(frame, image_box, settings)
            for side, view in zip(("front", "side"), views or (), strict=False):
                stem = re.sub(r"[^\w.-]+", "_", f"{recording}_{stored.key}_{number:02d}_step{step}_{side}")
                geometry = geometry_of(view, image_box)
                yield (
                    ViewPlace(
                        file_name=f"{stem}.png", recording=recording, frame=stored.key, step=step - 1, geometry=geometry
                    ),
                    view,
                )


def _drawn_boxes(project: Project) -> dict[int, list[tuple[Box2D, tuple[ViewBoxes, ...]]]]:
    return {each.frame_id: [(box, ()) for box in each.boxes] for each in project.boxes.on_images() if each.boxes}


def _drawn_pairs(project: Project) -> dict[int, list[tuple[Box2D, tuple[ViewBoxes, ...]]]]:
    """The objects with boxes on both views of the first step, by frame: their box on the image, and these views."""
    by_frame: dict[int, list[tuple[Box2D, tuple[ViewBoxes, ...]]]] = defaultdict(list)
    for (frame_id, image_box), steps in views_by_object(project.boxes.on_views()).items():
        if pair := front_and_side(steps[0]):
            by_frame[frame_id].append((image_box, pair))
    return by_frame


def image_follower(page: FramePage, payloads: Sequence[Payload]) -> ImageBoxesSet | None:
    """Returns the boxes on the image after a review of labels; None if they do not change.

    A drawn label that is deleted or rejected removes its box on the image. A rejected label that is accepted or edited
    restores it, so that detectors do not learn the object as background.
    """
    if page.image_boxes is None:
        return None
    drawn = {stored.label.uid: stored for stored in page.drawn}
    boxes = list(page.image_boxes.boxes)
    for payload in payloads:
        match payload:
            case LabelDeleted(uid=uid) | LabelChanged(uid=uid, state=ReviewState.REJECTED) if uid in drawn:
                boxes = [box for box in boxes if box != drawn[uid].image_box]
            case LabelChanged(uid=uid, state=state) if uid in drawn and state is not None:
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
        redrawn: the image box of an object that is being stored: all its views except `kept` are removed.
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
