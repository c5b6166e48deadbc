"""Small pictures of 3D boxes along their own axes: the three views to edit a box in, and the contact sheet of a track.

The object is seen from above, from its front, and from its right: a view shows the nearest points of the side that it
is named after. Points outside the box are dimmed. The pictures of contact sheets, whose boxes are accepted together,
are drawn ahead for the selected track, and kept.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8

from annotator.geometry.oriented_box import contains, reach_along
from annotator.geometry.projection import every_nth, thin
from annotator.image_bytes import encoded_image
from annotator.project import Effort, FramePart, Project, StoredFrame, WriteContext
from annotator.project.changes import LabelChanged
from annotator.rcv.pseudo_view import BACKGROUND, Window, draw_views, pack_colors, point_colors
from annotator.types import Frame, Label, OrientedBox, PointCloud, PseudoView, ReviewState
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.workflows.workbench.frame_cache import FrameCache, Memo, OpenFrame

# Margin on each side of a view, share of the box's longest side; and in front of and behind the box, share of its
# depth. Enough for context, without the wall behind.
MARGIN = 0.35
DEPTH_MARGIN = 0.5
# Points outside the box keep this share of their contrast to the background.
DIMMED = 0.3
# Larger clouds are thinned out to these numbers of points: views cannot show more.
MAX_INSIDE, MAX_AROUND = 40_000, 25_000


@dataclass(frozen=True)
class Axis:
    """The name of a view, and the box's axes that point right, down and into it: (axis, sign) each."""

    name: str
    right: tuple[int, int]
    down: tuple[int, int]
    depth: tuple[int, int]


# x length (its positive end is the front), y width (positive: left), z height. In the top view, the heading is up. In
# the others, height is up: in the front view, the object's left is on the right, as of a person who faces you; in the
# side view, which shows the right side, the heading is on the right.
AXES = (
    Axis("top", (1, -1), (0, -1), (2, -1)),
    Axis("front", (1, 1), (2, -1), (0, -1)),
    Axis("side", (0, 1), (2, -1), (1, 1)),
)


def ortho_views(opened: OpenFrame, box: OrientedBox, size_px: int) -> dict[str, PseudoView]:
    """Returns the views of a box by name: top, front, and side (the right one).

    Args:
        size_px: side length of each (square) view, pixels.
    """
    return views_of_points(opened.frame.cloud, opened.inside(shown_volume(box)), box, size_px)


def shown_volume(box: OrientedBox) -> OrientedBox:
    """Returns the box that encloses all points that the three views of a box may show."""
    longest_m = float(box.size_m.max())
    return replace(box, size_m=np.maximum(longest_m * (1 + 2 * MARGIN), box.size_m * (1 + 2 * DEPTH_MARGIN)))


def views_of_points(
    points: PointCloud, near: Int64[np.ndarray, "k"], box: OrientedBox, size_px: int
) -> dict[str, PseudoView]:
    """As `ortho_views`.

    Args:
        near: indices of the points in `shown_volume`.
    """
    cloud, is_inside = _near(points, near, box)
    colors = point_colors(cloud)
    if colors is not None:
        dim = BACKGROUND + DIMMED * (colors[~is_inside].astype(np.float32) - BACKGROUND)
        colors = colors.copy()
        colors[~is_inside] = dim.astype(np.uint8)
    local = (cloud.xyz_m - box.center_m.astype(np.float32)) @ box.rotation.astype(np.float32)
    return {axis.name: _view(axis, box, cloud, local, colors, size_px) for axis in AXES}


def _near(
    points: PointCloud, near: Int64[np.ndarray, "k"], box: OrientedBox
) -> tuple[PointCloud, Bool[np.ndarray, "n"]]:
    """Returns the points that the views may show, thinned out, and the mask of those in the box."""
    is_inside = contains(box, points.xyz_m[near])
    inside, around = every_nth(near[is_inside], MAX_INSIDE), every_nth(near[~is_inside], MAX_AROUND)
    cloud = replace(points, normals=None).select(np.concatenate([inside, around]))
    return cloud, np.arange(len(cloud)) < len(inside)


def _view(
    axis: Axis,
    box: OrientedBox,
    cloud: PointCloud,
    local: Float[np.ndarray, "n 3"],
    colors: UInt8[np.ndarray, "n 3"] | None,
    size_px: int,
) -> PseudoView:
    axes = axis.right, axis.down, axis.depth
    rows = np.stack([sign * box.rotation[:, which] for which, sign in axes])
    center = rows @ box.center_m
    sides = box.size_m[[axis.right[0], axis.down[0]]]
    scale = float(sides.max() * (1 + 2 * MARGIN)) / size_px
    origin = center[:2] - (size_px - 1) / 2 * scale
    along = np.stack([sign * local[:, which] for which, sign in axes])
    half = (size_px - 0.5) / 2 * scale
    depth = box.size_m[axis.depth[0]]
    shown = (np.abs(along[0]) < half) & (np.abs(along[1]) < half) & (np.abs(along[2]) < depth * (0.5 + DEPTH_MARGIN))
    rgb = np.full((size_px, size_px, 3), BACKGROUND, np.uint8)
    if shown.any():
        xyz = np.ascontiguousarray(along[:, shown], np.float32)
        depths = np.array([[xyz[2].min(), xyz[2].max()]])
        window = Window(origin - center[:2], scale, size_px, size_px)
        packed = pack_colors(None if colors is None else np.ascontiguousarray(colors[shown]), int(shown.sum()))
        (rgb,) = draw_views(xyz, packed, np.eye(3, dtype=np.float32)[None], [window], depths)
    assert np.linalg.det(rows) > 0, "right, down and into the view are a right-handed frame"
    return PseudoView(rgb, rows, scale, origin, cloud.xyz_m[shown])


# Side of each of the three views, and their distance, pixels; points that they are drawn from, at most.
VIEW_PX, GAP_PX, MOST_POINTS = 96, 2, 8_000
# Colours of the gap, of the box, and of its front.
GAP, LINE, FRONT = (24, 26, 30), (255, 209, 71), (255, 120, 60)


def picture(frame: Frame, box: OrientedBox) -> UInt8[np.ndarray, "h w 3"]:
    """Top, front and right side of a box beside each other, with its outline and its front marked, (96, 292, 3)."""
    strip = np.full((VIEW_PX, 3 * VIEW_PX + 2 * GAP_PX, 3), GAP, np.uint8)
    # an index of all points takes longer than the views
    near = np.flatnonzero(contains(shown_volume(box), frame.cloud.xyz_m))
    kept = thin(len(near), MOST_POINTS)
    views = views_of_points(frame.cloud, near if kept is None else near[kept], box, VIEW_PX)
    for number, (name, view) in enumerate(views.items()):
        left = number * (VIEW_PX + GAP_PX)
        part = strip[:, left : left + VIEW_PX]
        part[:] = view.rgb
        ends_m = reach_along(box, view.axes[:2]).T
        ends = np.rint((ends_m - view.origin_m) / view.metres_per_px).astype(int)
        (x0, y0), (x1, y1) = np.clip(ends, 0, VIEW_PX - 1).tolist()
        part[y0 : y1 + 1, [x0, x1]] = part[[y0, y1], x0 : x1 + 1] = LINE
        if name == "top":
            part[y0 : y0 + 2, x0 : x1 + 1] = FRONT
        elif name == "side":
            part[y0 : y1 + 1, x1 - 1 : x1 + 1] = FRONT
    return strip


@dataclass(frozen=True)
class SeenBox:
    """A proposal as the operator saw it: its frame, the frame's revision, and its uid."""

    frame_id: int
    revision: int
    uid: str


def accept_boxes(project: Project, boxes: Sequence[SeenBox], author: str, effort: Effort | None = None) -> None:
    """Accepts proposals in several frames, all or none, as one action."""
    if not boxes:
        raise ConfigError("no box is chosen, so there is nothing to accept; click on those that are right")
    by_frame: dict[int, list[SeenBox]] = {}
    for seen in boxes:
        stored = project.labels.get(seen.uid)
        if stored.frame_id != seen.frame_id or stored.label.state is not ReviewState.PROPOSED:
            raise ConfigError("a box of the sheet was reviewed or moved in the meantime; open the sheet again")
        by_frame.setdefault(seen.frame_id, []).append(seen)
    parts = [
        FramePart(
            frame_id,
            [LabelChanged(uid=seen.uid, state=ReviewState.ACCEPTED) for seen in chosen],
            WriteContext(chosen[0].revision, author, effort=None if number else effort),
        )
        for number, (frame_id, chosen) in enumerate(by_frame.items())
    ]
    project.log.append_to_frames(parts)


# A picture takes some 15 kB.
MOST_PICTURES = 4000
# Pause after each picture that is drawn ahead, so that requests go first, seconds.
PAUSE_S = 0.05


class SheetPictures:
    """Draws and keeps pictures of boxes. Thread-safe."""

    def __init__(self, frames: FrameCache) -> None:
        self._frames, self._pictures = frames, Memo(MOST_PICTURES)
        self._executor = ThreadPoolExecutor(1, "sheets")
        # what is drawn ahead: the boxes of the track that was asked for last
        self._ahead: Sequence[tuple[StoredFrame, Label]] = ()
        self._closed = threading.Event()

    def close(self) -> None:
        """Stops drawing ahead."""
        self._closed.set()
        self._executor.shutdown(wait=False, cancel_futures=True)

    def get(self, project: Project, stored: StoredFrame, box: OrientedBox) -> bytes:
        """The picture of a box as a PNG file; drawn once, even if several threads ask for it."""
        pose, adjusted = box.pose.tobytes(), project.adjustments.newest(stored.recording_id)
        # not its path: another project can take its place
        key = project, stored.id, stored.key, adjusted, pose, box.size_m.tobytes()
        return self._pictures.get(key, lambda: encoded_image(picture(self._frames.look(project, stored), box)))

    def prepare(self, project: Project, track: Sequence[tuple[StoredFrame, Label]]) -> None:
        """Draws pictures of a track in the background, in place of those of the former one."""
        self._ahead = track
        with suppress(RuntimeError):  # it was closed
            self._executor.submit(self._draw_ahead, project, track)

    def _draw_ahead(self, project: Project, track: Sequence[tuple[StoredFrame, Label]]) -> None:
        for stored, label in track:
            if self._ahead is not track or self._closed.wait(PAUSE_S):
                return
            if stored.index is not None:
                with suppress(AnnotatorError):  # shown on the sheet
                    self.get(project, stored, label.box)
