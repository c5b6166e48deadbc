"""Checks labelled pseudo-views, and copies them with their boxes into the project."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from annotator.files import read_file
from annotator.formats.reading import read_picture
from annotator.image_bytes import PNG_SIGNATURE
from annotator.project import Project, ViewGeometry, WriteContext
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, StaleRevisionError
from annotator.workflows.importing.boxes_3d import AUTHOR
from annotator.workflows.importing.image_boxes import Stored
from annotator.workflows.importing.picture_labels import PictureLabels
from annotator.workflows.views.pairs import ViewPlace


@dataclass(frozen=True)
class OnView:
    """Boxes of a pseudo-view with the image `file`; frame, step and geometry are None if unknown."""

    file: Path
    boxes: tuple[Box2D, ...]
    frame_id: int | None
    step: int | None
    geometry: ViewGeometry | None
    box_kind: BoxKind | None = None

    @property
    def image_box(self) -> Box2D | None:
        """The box on the camera image from which the view was rendered."""
        return None if self.geometry is None else self.geometry.image_box


def checked_views(
    project: Project, path: Path, pictures: Sequence[tuple[PictureLabels, ViewPlace | None]]
) -> tuple[OnView, ...]:
    """Checks the views of a dataset and finds their frames.

    Args:
        path: the dataset, for messages.
        pictures: the images, with their places if known.

    Raises:
        FormatError: an image is missing, not PNG, occurs twice, or has another size.
        NotFoundError: a frame that the project does not have.
    """
    views: list[OnView] = []
    # repeated images are refused: their boxes would replace those of the first
    names: dict[tuple[str, int | None], str] = {}
    for picture, place in pictures:
        file, size_px, digest = _checked_picture(path, picture)
        frame_id = None
        if place is not None and place.recording is not None and place.frame is not None:
            frame_id = project.frames.find(project.recordings.find(place.recording).id, place.frame).id
        step, geometry = (None, None) if place is None else (place.step, place.geometry)
        if (digest, frame_id) in names:
            raise FormatError(
                path, f"{names[digest, frame_id]} and {picture.file_name} are the same image; keep one of them"
            )
        names[digest, frame_id] = picture.file_name
        views.append(OnView(file, picture.boxes_on(*size_px), frame_id, step, geometry, picture.box_kind))
    return tuple(views)


def _checked_picture(path: Path, picture: PictureLabels) -> tuple[Path, tuple[int, int], str]:
    """Returns the image file, its width and height in pixels, and the hash of its content."""
    file = picture.file(path)
    if file is None:
        raise FormatError(path, f"{picture.file_name} is not in {picture.folder}; give the folder of the images")
    content, bgr = read_picture(file)
    if not content.startswith(PNG_SIGNATURE):
        raise FormatError(file, "is not a PNG image; save pseudo-views as PNG")
    height_px, width_px = bgr.shape[:2]
    if picture.size_px is not None and picture.size_px != (width_px, height_px):
        raise FormatError(
            path,
            f"{picture.file_name} is {width_px} x {height_px} pixels, but the label file says {picture.size_px[0]} x "
            f"{picture.size_px[1]}; label the image itself, not a scaled copy",
        )
    return file, (width_px, height_px), hashlib.sha256(content).hexdigest()


def store_on_view(
    project: Project, view: OnView, boxes: Sequence[Box2D], kind: BoxKind, revisions: Mapping[str, int]
) -> Stored:
    """Copies the image into the project and stores its boxes, unless the frame is finalised.

    Args:
        revisions: revisions of the project's views without a frame, by id.
    """
    if view.frame_id is not None and project.frames.get(view.frame_id).finalised:
        return Stored.LEFT_ALONE
    view_id = project.views.store(read_file(view.file))
    set_boxes = partial(
        project.boxes.set_on_view, view_id, boxes, kind, frame_id=view.frame_id, step=view.step, geometry=view.geometry
    )
    if view.frame_id is None:
        set_boxes(context=WriteContext(revisions.get(view_id, 0), AUTHOR, Source.IMPORTED))
        return Stored.KEPT
    while not (frame := project.frames.get(view.frame_id)).finalised:
        context = WriteContext(frame.revision, AUTHOR, Source.IMPORTED)
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            set_boxes(context=context)
            return Stored.KEPT
    return Stored.LEFT_ALONE
