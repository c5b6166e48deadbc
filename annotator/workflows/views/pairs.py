"""Stored pseudo-views: their origin (`views.json` beside the images), grouped by object and step, and drawn anew.

After a correction of a recording's calibration, its cloud has other colours, and a frustum holds other points. The
drawn boxes stay on their objects, because the views have moved with the cloud. So a picture is drawn anew in the window
that is stored, of the points that the view would show today.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from scipy.optimize import linear_sum_assignment

from annotator.files import TABLE_BYTES, read_file
from annotator.formats.json_file import write_text
from annotator.geometry.outline import MIN_SIDE_PX, box_on_image
from annotator.geometry.projection import in_frustum
from annotator.project import ViewBoxes, ViewGeometry
from annotator.project.log.records import Rotation3
from annotator.rcv.config import RcvConfig
from annotator.rcv.measure import box_iou, make_pair
from annotator.rcv.pseudo_view import Window, drawn_points, render_window, side_axes
from annotator.rcv.recursion import cut_cloud
from annotator.rcv.teach import MIN_POINTS
from annotator.types import Box2D, Camera, Frame, Label, PointCloud, PseudoView
from annotator.types.errors import FormatError

SIDECAR = "views.json"


class ViewPlace(BaseModel):
    """The origin of a pseudo-view image.

    Attributes:
        file_name: of the image.
        recording, frame: its frame; None for an image from elsewhere, which is used for training only.
        step: of the recursion, from 0; None if unknown.
        geometry: the view's position and axes in space; None if unknown.
        labelled: True if it was reviewed: without boxes it then shows no object.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

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
    try:
        return {place.file_name: place for place in _PLACES.validate_json(read_file(file, TABLE_BYTES))}
    except OSError as error:
        raise FormatError(file, f"cannot be read ({error.strerror})") from error
    except ValidationError as error:
        raise FormatError(file, f"is damaged: {error.errors()[0]['msg']}; write the views again") from error


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
                if _is_pair(front, side):
                    return front, side
    return None


def _is_pair(front: ViewBoxes, side: ViewBoxes) -> bool:
    if front.geometry is None or side.geometry is None:
        return False
    return _are_beside(front.geometry.axes, side.geometry.axes)


@lru_cache(maxsize=1024)
def _are_beside(front: Rotation3, side: Rotation3) -> bool:
    return bool(np.allclose(side_axes(np.array(front)), side, atol=SAME_AXES))


# 2D IoU from which a drawn box and an outline of the same class belong to the same object. Low, because the drawn box
# of a half hidden object is much smaller than its outline.
SAME_IOU = 0.2


def outlines(camera: Camera, labels: Sequence[Label], min_side_px: float = MIN_SIDE_PX) -> dict[str, Box2D]:
    """Returns the image box of each label by uid; labels outside the image are left out.

    Args:
        min_side_px: boxes with a shorter side are left out.
    """
    pairs = [(label.uid, box_on_image(camera, label.box, label.label, min_side_px)) for label in labels]
    return {uid: box for uid, box in pairs if box is not None}


def undrawn(
    camera: Camera, labels: Sequence[Label], drawn: Sequence[Box2D], min_side_px: float = MIN_SIDE_PX
) -> dict[str, Box2D]:
    """Returns the outlines by uid of the labels without a drawn box, after matching drawn boxes one to one.

    Args:
        min_side_px: as for `outlines`.
    """
    boxes = outlines(camera, labels, min_side_px)
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


def redrawn(
    frame: Frame, view: ViewBoxes, steps: Steps, size_px: SizePx, config: RcvConfig
) -> UInt8[np.ndarray, "h w 3"] | None:
    """The picture that a stored view shows of a frame; None if its drawn boxes enclose hardly a point.

    Args:
        view: with geometry and image box.
        steps: all views of the same object, by step.
        size_px: gives the width and height of a view's picture.
        config: how views are drawn; their size is that of the picture.
    """
    geometry = view.geometry
    assert geometry is not None and geometry.image_box is not None
    frustum = frame.cloud.select(in_frustum(frame.camera, frame.cloud.xyz_m, geometry.image_box))
    width_px, height_px = size_px(view)
    axes, drawn = np.array(geometry.axes), frustum
    if view.step:
        drawn = _cut(frustum, steps, size_px, config)
        keep = drawn_points(len(drawn), config.view.model_copy(update={"size_px": max(width_px, height_px)}))
        drawn = drawn if keep is None else drawn.select(keep)
    if view.boxes:
        low, high = spans_m(view).T
        on_view = drawn.xyz_m @ axes[:2].T
        if np.count_nonzero(((on_view >= low) & (on_view <= high)).all(axis=1)) < MIN_POINTS:
            return None
    window = Window(np.array(geometry.origin_m), geometry.metres_per_px, width_px, height_px)
    return render_window(drawn, axes, window, config.view.max_splat_px)


def _cut(frustum: PointCloud, steps: Steps, size_px: SizePx, config: RcvConfig) -> PointCloud:
    """The points in the boxes of the first step, as in `rcv.known_objects.next_views`; all if these boxes are gone."""
    pair = front_and_side(steps.get(0, ()))
    if pair is None:
        return frustum
    views = [
        view.geometry.view(np.zeros((*size_px(view)[::-1], 3), np.uint8)) for view in pair if view.geometry is not None
    ]
    front, side = ([replace(view.boxes[0], score=1.0)] for view in pair)
    both = views[0], views[1]
    box = make_pair(both[0].axes, both, front, side, 0, 0).box
    return cut_cloud(frustum, box, both, config)
