"""The contact sheet of a track: a small picture of each of its boxes, along its own axes, to be accepted together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from annotator.geometry.oriented_box import contains
from annotator.geometry.projection import thin
from annotator.project import Effort, FramePart, Project, Receipt, WriteContext
from annotator.project.event_types import LabelAccepted
from annotator.types import Frame, OrientedBox, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.workbench.ortho_views import shown_volume, views_of_points

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
    for number, item in enumerate(views):
        left = number * (VIEW_PX + GAP_PX)
        part = strip[:, left : left + VIEW_PX]
        part[:] = item.view.rgb
        axes = item.view.axes[:2]
        ends_m = axes @ box.center_m + np.array([[-1.0], [1.0]]) * _half_m(axes, box)
        ends = np.rint((ends_m - item.view.origin_m) / item.view.metres_per_px).astype(int)
        (x0, y0), (x1, y1) = np.clip(ends, 0, VIEW_PX - 1).tolist()
        part[y0 : y1 + 1, [x0, x1]] = part[[y0, y1], x0 : x1 + 1] = LINE
        if item.name == "top":
            part[y0 : y0 + 2, x0 : x1 + 1] = FRONT
        elif item.name == "side":
            part[y0 : y1 + 1, x1 - 1 : x1 + 1] = FRONT
    return strip


def _half_m(axes: np.ndarray, box: OrientedBox) -> np.ndarray:
    """Half of the box's extent along each axis of a view, metres."""
    return np.asarray(np.abs(axes @ box.rotation) @ box.size_m / 2)


@dataclass(frozen=True)
class SeenBox:
    """A proposal as the operator saw it: its frame, the frame's revision, and its uid."""

    frame_id: int
    revision: int
    uid: str


def accept_boxes(
    project: Project, boxes: Sequence[SeenBox], author: str, effort: Effort | None = None
) -> tuple[tuple[int, Receipt], ...]:
    """Accepts proposals in several frames, all or none, as one action; returns each frame's receipt.

    Args:
        effort: the operator's effort for this action.

    Raises:
        ConfigError: there is no box, or one of them is no proposal (any more).
        NotFoundError: no such frame or label.
        StaleRevisionError: a frame was changed since the operator saw it.
    """
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
            [LabelAccepted(uid=seen.uid) for seen in chosen],
            WriteContext(chosen[0].revision, author, effort=None if number else effort),
        )
        for number, (frame_id, chosen) in enumerate(by_frame.items())
    ]
    receipts = project.log.append_to_frames(parts)
    return tuple(zip(by_frame, receipts, strict=True))
