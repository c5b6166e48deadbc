"""Labelled camera images: which frames of the project they are, and whether their boxes fit there."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from annotator.formats.picture_file import read_picture
from annotator.project import Change, Project, StoredFrame
from annotator.project.overview import read_page
from annotator.project.payloads import ImageBoxesSet
from annotator.project.records import storable
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, FrameError, StaleRevisionError
from annotator.workflows.frames import FrameSource
from annotator.workflows.importing.boxes_3d import AUTHOR
from annotator.workflows.importing.frame_finder import FrameFinder, Renamed
from annotator.workflows.importing.picture_labels import PictureLabels, PictureSet
from annotator.workflows.view_followers import view_followers

# Files keep two decimals of a pixel or more; nobody draws the same box again so exactly.
ROUNDED_PX = 0.01


@dataclass(frozen=True)
class OnImage:
    """Boxes for the camera image of a frame; `file_name` for messages."""

    frame_id: int
    file_name: str
    boxes: tuple[Box2D, ...]


class Stored(Enum):
    """What became of the boxes for an image."""

    KEPT = "kept"
    # in place of others that somebody else had drawn
    REPLACED = "replaced"
    # the frame is finalised: nothing was changed
    LEFT_ALONE = "left alone"


@dataclass(frozen=True)
class CheckedImages:
    """Images with their frames, and what is told of the others.

    Attributes:
        unmatched: file names of images that belong to no frame.
        unreadable: frames that cannot be read, as `key: reason`.
        renamed: the dataset's only recording, where it was taken for one of another name.
    """

    matched: tuple[OnImage, ...]
    unmatched: tuple[str, ...]
    unreadable: tuple[str, ...]
    renamed: Renamed | None


def checked_images(
    project: Project, found: PictureSet, pictures: Sequence[PictureLabels], recording: str | None
) -> CheckedImages:
    """Finds each image's frame, and its boxes in the frame's pixels.

    Args:
        pictures: those of `found` that are camera images.
        recording: name of the only recording to look in.

    Raises:
        FormatError: an image that several recordings have, that comes twice, or that has another size than the frame;
            or none is of a frame of the project.
        NotFoundError: no such recording.
    """
    matched, unmatched, renamed = _matched(project, found, pictures, recording)
    source = FrameSource(project)
    ready, unreadable = [], []
    for picture, stored in matched:
        try:
            camera = source.read(stored).camera
        except FrameError as error:
            # there is nothing to compare with; whoever needs the frame will be told what is wrong with it
            if picture.size_px is not None:
                ready.append(OnImage(stored.id, picture.file_name, picture.boxes_on(*picture.size_px)))
            else:
                unreadable.append(f"{stored.key}: {error}")
            continue
        size_px = (camera.width_px, camera.height_px)
        _require_size(found.path, picture, size_px)
        ready.append(OnImage(stored.id, picture.file_name, picture.boxes_on(*size_px)))
    return CheckedImages(tuple(ready), tuple(unmatched), tuple(unreadable), renamed)


def _matched(
    project: Project, found: PictureSet, pictures: Sequence[PictureLabels], recording: str | None
) -> tuple[list[tuple[PictureLabels, StoredFrame]], list[str], Renamed | None]:
    """The images with their frames, the names of those that have none, and what their recording was taken for."""
    path = found.path
    frames = FrameFinder(project, recording, {origin.recording for origin in found.origins.values()})
    matched: dict[int, tuple[PictureLabels, StoredFrame]] = {}
    unmatched: list[str] = []
    for picture in pictures:
        origin = found.origins.get(picture.stem)
        key = picture.stem if origin is None else origin.key
        fitting = frames.find(None if origin is None else origin.recording, key)
        if len(fitting) > 1:
            raise FormatError(
                path, f"{picture.file_name}: {len(fitting)} recordings have a frame {key}; name one of them"
            )
        if not fitting:
            unmatched.append(picture.file_name)
        elif fitting[0].id in matched:
            other = matched[fitting[0].id][0].file_name
            raise FormatError(path, f"{other} and {picture.file_name} are both the frame {key}; keep one of them")
        else:
            matched[fitting[0].id] = (picture, fitting[0])
    if not matched:
        raise FormatError(
            path,
            "none of its images is a frame of the project; a file's name without its suffix must be the frame's key "
            "(000012.jpg is the frame 000012)",
        )
    named = (stored for picture, stored in matched.values() if picture.stem in found.origins)
    return list(matched.values()), unmatched, frames.renamed(named)


def _require_size(path: Path, picture: PictureLabels, size_px: tuple[int, int]) -> None:
    """Boxes on a scaled copy of the image would be taken for boxes on the image, shares of a cut one for shares."""
    width_px, height_px = size_px
    if picture.size_px is not None:
        if picture.size_px != size_px:
            raise FormatError(
                path,
                f"{picture.file_name} is {picture.size_px[0]} x {picture.size_px[1]} pixels, the frame {width_px} x "
                f"{height_px}; label the image itself, not a scaled copy",
            )
        return
    file = picture.file(path)
    if file is None:
        return
    height, width = read_picture(file)[1].shape[:2]
    # a scaled copy has whole pixels, too
    if abs(width * height_px - height * width_px) > max(width_px, height_px):
        raise FormatError(
            path,
            f"{picture.file_name} is {width} x {height} pixels and the frame {width_px} x {height_px}: of another "
            "shape; label the whole image, neither cut nor filled up",
        )


def store_on_image(
    project: Project, path: Path, image: OnImage, boxes: Sequence[Box2D], kind: BoxKind, drawn_from: Sequence[Box2D]
) -> Stored:
    """Sets the boxes of a frame's camera image, and what follows for those on its views; not of a finalised frame.

    Args:
        path: where they come from, for messages.
        drawn_from: boxes on the same image that views coming along were drawn from.
    """
    while True:
        page = read_page(project, image.frame_id)
        if page.frame.finalised:
            return Stored.LEFT_ALONE
        before = () if page.image_boxes is None else page.image_boxes.boxes
        with storable(f"{path}: {image.file_name}"):
            on_image = ImageBoxesSet(boxes=tuple(_as_known([*drawn_from, *before], boxes)), box_kind=kind)
        change = Change(page.frame.revision, AUTHOR, Source.IMPORTED)
        # somebody may have changed the frame between the lines
        with suppress(StaleRevisionError):
            project.log.append(image.frame_id, [on_image, *view_followers(page, on_image)], change)
            is_drawn = page.image_boxes is not None and page.image_boxes.author != AUTHOR
            return Stored.REPLACED if is_drawn and before != on_image.boxes else Stored.KEPT


def _as_known(known: Sequence[Box2D], boxes: Sequence[Box2D]) -> list[Box2D]:
    """Boxes as they were, where a file has only rounded them: what was drawn from them stays."""
    return [next((other for other in known if _is_rounded(box, other)), box) for box in boxes]


def _is_rounded(box: Box2D, known: Box2D) -> bool:
    return box.label == known.label and bool(np.allclose(box.xyxy, known.xyxy, rtol=0, atol=ROUNDED_PX))
