"""Requests to the annotation API of the project `room`."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np

from annotator.project import Project, WriteContext
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Source

ROOM = "/api/projects/room"
BOX = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [0.9, 0.1, 0.4, 0.1]}


def propose(project: Project, frame: int, *places: float) -> list[str]:
    """Creates proposals in front of the camera at these x coordinates, metres; returns their uids."""
    proposals = [
        Proposal(
            "person",
            0.8,
            OrientedBox.from_parts(np.array([x, 0.0, 3.0]), np.eye(3), np.array([0.8, 0.5, 1.7])),
            Box2D("person", 1.0, 2.0, 30.0, 40.0),
            (),
            Quality(0.1, 0.9, 0.05, 0.8, 0.2),
        )
        for x in places
    ]
    context = WriteContext(project.frames.get(frame).revision, "rcv", Source.AUTO)
    return [uid for uid in project.proposals.replace(frame, proposals, context).uids if uid is not None]


def state(client: httpx.Client, frame: int = 1) -> dict[str, Any]:
    """The state of a frame."""
    answer = client.get(f"{ROOM}/frames/{frame}")
    assert answer.status_code == 200, answer.text
    frame_state: dict[str, Any] = answer.json()
    return frame_state


def change(client: httpx.Client, revision: int, *changes: dict[str, Any], frame: int = 1) -> httpx.Response:
    """Sends changes of a frame like the page."""
    return client.post(f"{ROOM}/frames/{frame}/changes", json={"revision": revision, "changes": list(changes)})
