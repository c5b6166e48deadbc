"""Camera images and pseudo-views as files that a browser may keep."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from fastapi.responses import Response

from annotator.types.errors import ProjectError
from annotator.web.context import Ctx
from annotator.web.wire import RowId

router = APIRouter(tags=["pictures"])

# The address names the content (the page adds a version to an image's), so it never has to be asked for again.
FOR_EVER = "private, max-age=31536000, immutable"

ViewId = Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]


@router.get("/api/projects/{name}/frames/{frame_id}/image.jpg", response_class=Response)
def image(ctx: Ctx, name: str, frame_id: RowId, v: str | None = None) -> Response:
    """The camera image. With the version `v` that a frame's state names, the browser may keep it."""
    opened = ctx.annotation.frames.open(ctx.project(name), frame_id)
    return Response(opened.jpeg, media_type="image/jpeg", headers={"Cache-Control": FOR_EVER if v else "no-cache"})


@router.get("/api/projects/{name}/views/{view_id}.png", response_class=Response)
def view(ctx: Ctx, name: str, view_id: ViewId) -> Response:
    """The picture of a pseudo-view: one that is on a screen now, or one that the project keeps."""
    project = ctx.project(name)
    content = ctx.annotation.pictures.get(view_id)
    if content is None:
        path = project.views.path(view_id)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise ProjectError(f"{path}: cannot be read: {error}") from error
    return Response(content, media_type="image/png", headers={"Cache-Control": FOR_EVER, "ETag": f'"{view_id}"'})
