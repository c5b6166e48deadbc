"""Labelled pictures of pseudo-views: read, checked and copied into the project."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from annotator.formats.picture_file import read_picture
from annotator.pictures import PNG_SIGNATURE
from annotator.project import Change, Project, ViewGeometry
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, StaleRevisionError
from annotator.workflows.importing.boxes_3d import AUTHOR
from annotator.workflows.importing.image_boxes import Stored
from annotator.workflows.importing.picture_labels import PictureLabels
from annotator.workflows.views_out import ViewPlace


@dataclass(frozen=True)
class OnView:
    """Boxes for a pseudo-view whose picture lies in `file`; frame, step and geometry as far as they are known."""

    file: Path
    boxes: tuple[Box2D, ...]
    frame_id: int | None
    step: int | None
    geometry: ViewGeometry | None

    @property
    def image_box(self) -> Box2D | None:
        """The box on the camera image that the view was drawn from."""
        return None if self.geometry is None else self.geometry.image_box


def checked_views(
    project: Project, path: Path, pictures: Sequence[tuple[PictureLabels, ViewPlace | None]]
) -> tuple[OnView, ...]:
    """The views of a dataset with their frames.

    Args:
        path: where they come from, for messages.
        pictures: with their places, where they are known.

    Raises:
        FormatError: a picture is missing, no PNG, there twice, or of another size.
        NotFoundError: a frame that the project does not have.
    """
    views: list[OnView] = []
    # the boxes of a picture that comes again would replace the first ones
    names: dict[tuple[str, int | None], str] = {}
    for picture, place in pictures:
        file, size_px, digest = _checked_picture(path, picture)
        frame_id = None
        if place is not None and place.recording is not None and place.frame is not None:
            frame_id = project.frames.find(project.recordings.find(place.recording).id, place.frame).id
        known = (None, None) if place is None else (place.step, place.geometry)
        if (digest, frame_id) in names:
            raise FormatError(
                path, f"{names[digest, frame_id]} and {picture.file_name} are the same picture; keep one of them"
            )
        names[digest, frame_id] = picture.file_name
        views.append(OnView(file, picture.boxes_on(*size_px), frame_id, *known))
    return tuple(views)


def _checked_picture(path: Path, picture: PictureLabels) -> tuple[Path, tuple[int, int], str]:
    """The picture's file, its width and height in pixels, and the hash of its content."""
    file = picture.file(path)
    if file is None:
        raise FormatError(path, f"{picture.file_name} is not in {picture.folder}; give the folder of the pictures")
    content, bgr = read_picture(file)
    if not content.startswith(PNG_SIGNATURE):
        raise FormatError(file, "is no PNG picture; pseudo-views are kept as PNG")
    height_px, width_px = bgr.shape[:2]
    if picture.size_px is not None and picture.size_px != (width_px, height_px):
        raise FormatError(
            path,
            f"{picture.file_name} is {width_px} x {height_px} pixels, the file says {picture.size_px[0]} x "
            f"{picture.size_px[1]}; label the picture itself, not a scaled copy",
        )
    return file, (width_px, height_px), hashlib.sha256(content).hexdigest()


def store_on_view(
    project: Project, view: OnView, boxes: Sequence[Box2D], kind: BoxKind, revisions: Mapping[str, int]
) -> Stored:
    """Copies the picture into the project and sets its boxes; not where it is of a finalised frame.

    Args:
        revisions: of the views without a frame that the project has, by id.
    """
    if view.frame_id is not None and project.frames.get(view.frame_id).finalised:
        return Stored.LEFT_ALONE
    view_id = project.views.store(view.file.read_bytes())
    set_boxes = partial(
        project.boxes.set_on_view, view_id, boxes, kind, frame_id=view.frame_id, step=view.step, geometry=view.geometry
    )
    if view.frame_id is None:
        set_boxes(change=Change(revisions.get(view_id, 0), AUTHOR, Source.IMPORTED))
        return Stored.KEPT
    while not (frame := project.frames.get(view.frame_id)).finalised:
        change = Change(frame.revision, AUTHOR, Source.IMPORTED)
        # somebody may have changed the frame between the lines
        with suppress(StaleRevisionError):
            set_boxes(change=change)
            return Stored.KEPT
    return Stored.LEFT_ALONE
