"""Camera images and images of pseudo-views, which browsers may cache."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import Response

from annotator.web.context import Ctx
from annotator.web.schemas import RowId

router = APIRouter(tags=["frames"])

# The URL identifies the content (an image's URL contains a version), so it may be cached forever.
CACHE_FOREVER = "private, max-age=31536000, immutable"

ViewId = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]


@router.get("/api/projects/{name}/frames/{frame_id}/image.jpg", response_class=Response)
def image(ctx: Ctx, name: str, frame_id: RowId, v: str | None = None) -> Response:
    """The camera image. With the version `v` from a frame's state, browsers may cache it."""
    opened = ctx.caches.frames.open(ctx.project(name), frame_id)
    return Response(opened.jpeg, media_type="image/jpeg", headers={"Cache-Control": CACHE_FOREVER if v else "no-cache"})


@router.get("/api/projects/{name}/views/{view_id}.png", response_class=Response)
def view(ctx: Ctx, name: str, view_id: ViewId) -> Response:
    """The image of a pseudo-view, from the cache or the project."""
    project = ctx.project(name)
    content = ctx.caches.view_images.get(view_id)
    if content is None:
        content = project.views.content(view_id)
    return Response(content, media_type="image/png", headers={"Cache-Control": CACHE_FOREVER, "ETag": f'"{view_id}"'})
