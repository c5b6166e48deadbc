"""Bags before they are added: their topics and a picture of the first frame."""

from __future__ import annotations

import base64
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel

from annotator.recordings.recording import parse_options
from annotator.recordings.ros.topics import TopicReport
from annotator.web.context import Ctx, Operator
from annotator.workflows.workbench.frame_state import preview_bag

router = APIRouter(tags=["recordings"])

BagPath = Annotated[str, Query(min_length=1, max_length=4096)]
TopicName = Annotated[str | None, Query(max_length=1024)]


class BagChoice(BaseModel):
    """A bag as it would be read.

    Attributes:
        frames: their number; 0 if it cannot be read.
        notes: what the reader says about it.
        problem: why it cannot be read, and what to choose; "" if it can.
        picture: the first frame with its points, as a `data:` URL; "" if it cannot be read.
    """

    topics: list[TopicReport]
    frames: int
    notes: list[str]
    problem: str
    picture: str


@router.get("/api/bags")
def bag(
    ctx: Ctx,
    operator: Operator,
    path: BagPath,
    image: TopicName = None,
    points: TopicName = None,
    depth: TopicName = None,
    camera_info: TopicName = None,
    depth_info: TopicName = None,
) -> BagChoice:
    """The topics of a bag below one of the server's folders, and its first frame with these topics."""
    chosen = {
        "image": image, "points": points, "depth": depth, "camera_info": camera_info, "depth_info": depth_info,
    }  # fmt: skip
    options = parse_options(**{name: topic or None for name, topic in chosen.items()})
    found = preview_bag(ctx.folders.find(path), options)
    picture = "" if found.jpeg is None else f"data:image/jpeg;base64,{base64.b64encode(found.jpeg).decode()}"
    return BagChoice(
        topics=list(found.topics), frames=found.frames, notes=list(found.notes),
        problem=_public(ctx, found.problem, [topic.name for topic in found.topics]), picture=picture,
    )  # fmt: skip


def _public(ctx: Ctx, text: str, topics: list[str]) -> str:
    """Returns a message for browsers, in which the names of topics, which look like paths, stay."""
    names = sorted(topics, key=len, reverse=True)
    for number, name in enumerate(names):
        text = text.replace(name, f"<{number}>")
    text = ctx.public_message(text)
    for number, name in enumerate(names):
        text = text.replace(f"<{number}>", name)
    return text
