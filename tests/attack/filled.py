"""A large project, written in a moment."""

from __future__ import annotations

import numpy as np

from annotator.project import FramePart, Project, WriteContext
from annotator.project.changes import NewLabel
from annotator.types import BoxKind, OrientedBox, Source


def fill(project: Project, frames: int, labels: int, views: int) -> None:
    """Adds one recording with reviewed labels, and pseudo-views with boxes."""
    keys = [f"{n:06d}" for n in range(frames)]
    recording = project.recordings.add(project.path.parent / "recording", "rgbd", "long", keys, True)
    stored = project.frames.of([recording.id])
    shares = [labels * (n + 1) // frames - labels * n // frames for n in range(frames)]
    parts = [
        FramePart(frame.id, [_label(n, k) for k in range(share)], WriteContext(0, "Ada", Source.MANUAL))
        for n, (frame, share) in enumerate(zip(stored, shares, strict=True))
        if share
    ]
    for first in range(0, len(parts), 500):
        project.log.append_to_frames(parts[first : first + 500])
    rng = np.random.default_rng(0)
    for _ in range(views):
        picture = rng.integers(0, 255, (60, 60, 3), np.uint8)
        project.boxes.set_on_view(project.views.store(picture), [], BoxKind.BOX, WriteContext(0, "Ada", Source.MANUAL))


def _label(frame: int, number: int) -> NewLabel:
    box = OrientedBox.from_parts(np.array([2.0 * number, 0.1, 3.0]), np.eye(3), np.array([1.0, 0.7, 0.4]))
    return NewLabel("person", box, uid=f"{frame}-{number}")
