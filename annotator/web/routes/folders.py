"""Where recordings may be added from."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel

from annotator.web.context import Ctx, Operator

router = APIRouter(prefix="/api/folders", tags=["folders"])

FolderPath = Annotated[str, Query(max_length=4096)]


class FolderEntry(BaseModel):
    """A sub-folder, a recording, or both."""

    name: str
    path: str
    recording: str | None
    is_folder: bool


class FolderListing(BaseModel):
    """What is in a folder."""

    path: str
    parent: str | None
    entries: list[FolderEntry]


@router.get("")
def folders(ctx: Ctx, who: Operator, path: FolderPath = "") -> FolderListing:
    """The sub-folders and recordings in a folder; "" lists the folders that the server was told of."""
    listing = ctx.folders.list(path)
    entries = [FolderEntry(**asdict(entry)) for entry in listing.entries]
    return FolderListing(path=listing.path, parent=listing.parent, entries=entries)
