"""A server with one cloud of a LiDAR, and an object that two of four virtual cameras see."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from annotator.project import NewLabel, Project, WriteContext, create_project
from annotator.types import OrientedBox, Source
from annotator.web.security import ServerSettings

# 45 degrees to the left of ahead.
PLACE = np.array([10.0, 10.0, 0.0])


def rig_settings(folder: Path) -> ServerSettings:
    """Settings of a server with the empty project `room`, and the folder `clouds` with the recording `drive`."""
    rng = np.random.default_rng(0)
    (folder / "clouds" / "drive").mkdir(parents=True)
    points = np.vstack([rng.uniform([-30, -30, -2], [30, 30, -1.6], (3000, 3)), PLACE + rng.normal(0, 0.5, (500, 3))])
    np.save(folder / "clouds" / "drive" / "0.npy", points.astype(np.float32))
    create_project(folder / "projects", "room", ("car",)).close()
    return ServerSettings(folder / "projects", (folder / "clouds",), port=0)


def label_object(project: Project, frame_id: int, right_m: float) -> str:
    """Labels the object in a level camera's frame; returns the label's uid.

    Args:
        right_m: how far it is to the camera's right: -10 for the camera that looks ahead, 10 for the one to its left.
    """
    box = OrientedBox.from_parts(np.array([right_m, 0.0, 10.0]), np.eye(3), np.array([2.0, 2.0, 2.0]))
    context = WriteContext(project.frames.get(frame_id).revision, "maria", Source.MANUAL)
    return project.labels.create(frame_id, [NewLabel("car", box, track_id=3)], context).uids[0]
