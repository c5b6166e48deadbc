"""2D boxes on camera images and on pseudo-views, the detectors' training data, and the images of the views."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from sqlalchemy import Connection, bindparam, select

from annotator.files import open_file, read_file, write_atomic
from annotator.image_bytes import PNG_SIGNATURE, declared_size, encoded_image
from annotator.project.audit.writing import Receipt, WriteContext
from annotator.project.changes import ImageBoxesSet, ViewBoxesSet
from annotator.project.database.schema import AnyRow, frames, image_labels, labels, view_labels
from annotator.project.log import Writer
from annotator.project.records import ViewGeometry, storable
from annotator.project.rows import Terms
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import RESTORE, NotFoundError, ProjectError

# --- images of pseudo-views -------------------------------------------------------------------------------------------

# Of a PNG file of ours, to the first of its pixels.
HEADER_BYTES = 64
_ID = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Views:
    """The folder of images.

    Attributes:
        folder: holds one `<id>.png` per view.
    """

    folder: Path

    def store(self, image: bytes | UInt8[np.ndarray, "h w 3"]) -> str:
        """Stores an image, a PNG file or (H, W, 3) uint8 RGB, once; returns its id, the SHA-256 (hex) of its PNG."""
        content = image if isinstance(image, bytes) else encoded_image(image)
        if not content.startswith(PNG_SIGNATURE):
            raise ProjectError(f"{self.folder}: only PNG images can be stored; convert the image first")
        view_id = hashlib.sha256(content).hexdigest()
        path = self._file(view_id)
        if path.is_symlink() or not path.exists():
            try:
                write_atomic(path, content)
            except OSError as error:
                raise ProjectError(f"{path}: cannot be written: {error}") from error
        return view_id

    def path(self, view_id: str) -> Path:
        """The file of an image."""
        if not _ID.fullmatch(view_id):
            raise NotFoundError(f"{view_id!r} is not the id of a view; ids have 64 hexadecimal digits")
        path = self._file(view_id)
        # a link in a project that somebody sent could lead to any file
        if path.is_symlink() or not path.is_file():
            raise NotFoundError(f"view {view_id[:12]}: the image is missing; store it first, or {RESTORE}")
        return path

    def load(self, view_id: str) -> UInt8[np.ndarray, "h w 3"]:
        """The image, (H, W, 3) uint8, RGB order."""
        import cv2

        bgr = cv2.imdecode(np.frombuffer(self.content(view_id), np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            raise ProjectError(f"{self._file(view_id)}: cannot be decoded as an image; {RESTORE}")
        return np.ascontiguousarray(bgr[..., ::-1])

    def content(self, view_id: str) -> bytes:
        """The bytes of an image's PNG file."""
        path = self.path(view_id)
        try:
            content = read_file(path)
        except OSError as error:
            raise ProjectError(f"{path}: cannot be read: {error}") from error
        if hashlib.sha256(content).hexdigest() != view_id:
            raise ProjectError(f"{path}: is damaged (its content does not match its name); {RESTORE}")
        return content

    def size(self, view_id: str) -> tuple[int, int]:
        """Width and height of an image, pixels, from the header of its file."""
        return _size_of(self, view_id)

    def _file(self, view_id: str) -> Path:
        return self.folder / f"{view_id}.png"


@lru_cache(maxsize=4096)
def _size_of(views: Views, view_id: str) -> tuple[int, int]:
    """The size of an image, which never changes: a page needs that of all views of its frame after each change."""
    path = views.path(view_id)
    try:
        with open_file(path) as file:
            size = declared_size(file.read(HEADER_BYTES))
    except OSError as error:
        raise ProjectError(f"{path}: cannot be read: {error}") from error
    if size == (0, 0):
        raise ProjectError(f"{path}: is damaged; {RESTORE}")
    return size


@dataclass(frozen=True)
class _Boxes:
    boxes: tuple[Box2D, ...]
    box_kind: BoxKind
    author: str
    time_ns: int
    source: Source
    event_id: int


@dataclass(frozen=True)
class ImageBoxes(_Boxes):
    """All boxes on the camera image of one frame; an empty tuple = the image shows no object.

    Attributes:
        boxes: in the image's pixels.
        author, time_ns, source, event_id: of the latest change.
    """

    frame_id: int


@dataclass(frozen=True)
class ViewBoxes(_Boxes):
    """As `ImageBoxes`, on one pseudo-view.

    Attributes:
        view_id: id of the view's image, for `Views.load`.
        frame_id: the frame that the view was rendered from, or None.
        revision: of the frame, or of a view without a frame, after the latest change.
        step: the step of the recursion that rendered the view, from 0, if known.
        geometry: pose and scale of the view, if known.
    """

    view_id: str
    frame_id: int | None
    revision: int
    step: int | None
    geometry: ViewGeometry | None


@dataclass(frozen=True, eq=False)
class Boxes:
    """Reads and sets 2D boxes; setting replaces all boxes on that image or view."""

    writer: Writer
    views: Views

    def set_on_image(self, frame_id: int, boxes: Sequence[Box2D], box_kind: BoxKind, context: WriteContext) -> Receipt:
        """Sets all boxes on the camera image of a frame."""
        with storable("boxes on the image"):
            payload = ImageBoxesSet(boxes=tuple(boxes), box_kind=box_kind)
        return self.writer.append(frame_id, (payload,), context)

    def set_on_view(
        self,
        view_id: str,
        boxes: Sequence[Box2D],
        box_kind: BoxKind,
        context: WriteContext,
        *,
        frame_id: int | None = None,
        step: int | None = None,
        geometry: ViewGeometry | None = None,
    ) -> Receipt:
        """Sets all boxes on a pseudo-view whose image is stored.

        Args:
            context: with the revision of the frame, or for a view without a frame that of the view, initially 0.
            frame_id: the frame that the view was rendered from; None for imported images.
        """
        self.views.path(view_id)
        with storable(f"boxes on view {view_id[:12]}"):
            payload = ViewBoxesSet(view=view_id, boxes=tuple(boxes), box_kind=box_kind, step=step, geometry=geometry)
        if frame_id is None:
            return self.writer.to_view(payload, context)
        return self.writer.append(frame_id, (payload,), context)

    def on_image(self, frame_id: int) -> ImageBoxes | None:
        """The boxes on the image of one frame, or None if it is unlabelled."""
        with self.writer.store.read() as connection:
            return read_image_boxes(connection, frame_id)

    def on_images(self, recordings: Collection[int] | None = None) -> tuple[ImageBoxes, ...]:
        """All labelled images of some recordings, or of the whole project, in the frames' order."""
        query = select(image_labels).join(frames, frames.c.id == image_labels.c.frame_id)
        if recordings is not None:
            query = query.where(frames.c.recording_id.in_(recordings))
        ordered = query.order_by(frames.c.recording_id, frames.c.position.nulls_last(), frames.c.id)
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            return tuple(_image_boxes(row, terms) for row in connection.execute(ordered))

    def frames_with_images(self) -> frozenset[int]:
        """Ids of the frames with a labelled camera image."""
        with self.writer.store.read() as connection:
            return frozenset(connection.execute(select(image_labels.c.frame_id)).scalars())

    def frames_without_labels(self) -> tuple[int, ...]:
        """Ids of the frames with boxes on their image but no 3D label, in order; finalised frames are left out."""
        query = (
            select(image_labels.c.frame_id)
            .join(frames, frames.c.id == image_labels.c.frame_id)
            .where(
                image_labels.c["count"] > 0,
                ~frames.c.finalised,
                image_labels.c.frame_id.not_in(select(labels.c.frame_id)),
            )
            .order_by(image_labels.c.frame_id)
        )
        with self.writer.store.read() as connection:
            return tuple(connection.execute(query).scalars())

    def on_views_of(self, frame_id: int) -> tuple[ViewBoxes, ...]:
        """All labelled pseudo-views of one frame."""
        with self.writer.store.read() as connection:
            return read_view_boxes(connection, frame_id)

    def on_views(self) -> tuple[ViewBoxes, ...]:
        """All labelled pseudo-views of the project, including those without a frame."""
        query = select(view_labels).order_by(view_labels.c.event_id)
        with self.writer.store.read() as connection:
            terms = Terms(connection)
            return tuple(_view_boxes(row, terms) for row in connection.execute(query))


# Built once, since building these frequent queries takes longer than running them.
_ON_IMAGE = select(image_labels).where(image_labels.c.frame_id == bindparam("frame"))
_ON_VIEWS = select(view_labels).where(view_labels.c.frame_id == bindparam("frame")).order_by(view_labels.c.event_id)


def read_image_boxes(connection: Connection, frame_id: int) -> ImageBoxes | None:
    """As `Boxes.on_image`, within the caller's transaction."""
    row = connection.execute(_ON_IMAGE, {"frame": frame_id}).first()
    return None if row is None else _image_boxes(row, Terms(connection))


def read_view_boxes(connection: Connection, frame_id: int) -> tuple[ViewBoxes, ...]:
    """As `Boxes.on_views_of`, within the caller's transaction."""
    terms = Terms(connection)
    return tuple(_view_boxes(row, terms) for row in connection.execute(_ON_VIEWS, {"frame": frame_id}))


def _image_boxes(row: AnyRow, terms: Terms) -> ImageBoxes:
    return ImageBoxes(**_columns(ImageBoxes, row, terms))


def _view_boxes(row: AnyRow, terms: Terms) -> ViewBoxes:
    return ViewBoxes(**_columns(ViewBoxes, row, terms) | {"geometry": terms.geometry(row.geometry, row.frame_id)})


def _columns(kind: type[ImageBoxes | ViewBoxes], row: AnyRow, terms: Terms) -> dict[str, Any]:
    columns = {each.name: getattr(row, each.name) for each in fields(kind)}
    values = {"boxes": terms.boxes_2d(row.boxes), "box_kind": BoxKind(row.box_kind), "source": Source(row.source)}
    return columns | values
