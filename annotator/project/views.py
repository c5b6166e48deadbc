"""Images of labelled pseudo-views, each named by the hash of its content."""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from annotator.files import open_file, read_file, write_atomic
from annotator.types.errors import RESTORE, NotFoundError, ProjectError

_PNG = b"\x89PNG\r\n\x1a\n"
_ID = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Views:
    """The folder of images.

    Attributes:
        folder: holds one `<id>.png` per view.
    """

    folder: Path

    def store(self, image: bytes | UInt8[np.ndarray, "h w 3"]) -> str:
        """Stores an image unless it is stored already; returns its id, the SHA-256 (hex) of its PNG.

        Args:
            image: the bytes of a PNG file, or (H, W, 3) uint8, RGB order.

        Raises:
            ProjectError: not a PNG, or it cannot be written.
        """
        content = image if isinstance(image, bytes) else png(image)
        if not content.startswith(_PNG):
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
        """The file of an image.

        Raises:
            NotFoundError: no such image.
        """
        if not _ID.fullmatch(view_id):
            raise NotFoundError(f"{view_id!r} is not the id of a view; ids have 64 hexadecimal digits")
        path = self._file(view_id)
        # a link in a project that somebody sent could lead to any file
        if path.is_symlink() or not path.is_file():
            raise NotFoundError(f"view {view_id[:12]}: the image is missing; store it first, or {RESTORE}")
        return path

    def load(self, view_id: str) -> UInt8[np.ndarray, "h w 3"]:
        """The image, (H, W, 3) uint8, RGB order.

        Raises:
            ProjectError: it is missing, or its content does not match its id.
        """
        return _decode(self._file(view_id), self.content(view_id))

    def content(self, view_id: str) -> bytes:
        """The bytes of an image's PNG file.

        Raises:
            ProjectError: it is missing, or does not match its id.
        """
        path = self.path(view_id)
        try:
            content = read_file(path)
        except OSError as error:
            raise ProjectError(f"{path}: cannot be read: {error}") from error
        if hashlib.sha256(content).hexdigest() != view_id:
            raise ProjectError(f"{path}: is damaged (its content does not match its name); {RESTORE}")
        return content

    def size(self, view_id: str) -> tuple[int, int]:
        """Width and height of an image, pixels, from the header of its file.

        Raises:
            NotFoundError: no such image.
            ProjectError: it cannot be read.
        """
        return _size_of(self, view_id)

    def _file(self, view_id: str) -> Path:
        return self.folder / f"{view_id}.png"


@lru_cache(maxsize=4096)
def _size_of(views: Views, view_id: str) -> tuple[int, int]:
    """The size of an image, which never changes: a page needs that of all views of its frame after each change."""
    path = views.path(view_id)
    try:
        with open_file(path) as file:
            head = file.read(24)
    except OSError as error:
        raise ProjectError(f"{path}: cannot be read: {error}") from error
    # the header chunk is the first one: its length and name, then width and height as big-endian words
    if not head.startswith(_PNG) or len(head) < 24:
        raise ProjectError(f"{path}: is damaged; {RESTORE}")
    width, height = struct.unpack(">II", head[16:24])
    return width, height


def png(rgb: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """An image, (H, W, 3) uint8, RGB order, as the bytes of a PNG file; deterministic."""
    import cv2

    is_encoded, content = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    if not is_encoded:
        raise ProjectError(f"an image of shape {rgb.shape} cannot be encoded as PNG")
    return content.tobytes()


def _decode(path: Path, content: bytes) -> np.ndarray:
    import cv2

    bgr = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        raise ProjectError(f"{path}: cannot be decoded as an image; {RESTORE}")
    return np.ascontiguousarray(bgr[..., ::-1])
