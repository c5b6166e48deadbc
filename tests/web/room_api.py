"""The annotation API of the project `room`, as tests ask it."""

from __future__ import annotations

from typing import Any

import httpx
import numpy as np

from annotator.project import Change, Project
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Source

ROOM = "/api/projects/room"
BOX = {"center": [0.1, 0.2, 3.0], "size": [0.8, 0.5, 1.7], "quaternion": [0.9, 0.1, 0.4, 0.1]}


def propose(project: Project, frame: int, *places: float) -> list[str]:
    """Proposals in front of the camera, at these x, metres; their uids."""
    proposals = [
        Proposal(
            "person",
            0.8,
            OrientedBox.from_parts(np.array([x, 0.0, 3.0]), np.eye(3), np.array([0.8, 0.5, 1.7])),
            Box2D("person", 1.0, 2.0, 30.0, 40.0),
            (),
            Quality(0.1, 0.9, 0.05, 0.8),
        )
        for x in places
    ]
    change = Change(project.frames.get(frame).revision, "rcv", Source.AUTO)
    return [uid for uid in project.proposals.replace(frame, proposals, change).uids if uid is not None]


def state(client: httpx.Client, frame: int = 1) -> dict[str, Any]:
    """All that a page shows of a frame."""
    found = client.get(f"{ROOM}/frames/{frame}")
    assert found.status_code == 200, found.text
    answer: dict[str, Any] = found.json()
    return answer


def change(client: httpx.Client, revision: int, *changes: dict[str, Any], frame: int = 1) -> httpx.Response:
    """Changes of a frame, as a page sends them."""
    return client.post(f"{ROOM}/frames/{frame}/changes", json={"revision": revision, "changes": list(changes)})
