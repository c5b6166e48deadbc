"""Matches labelled camera images with the project's frames, and stores their boxes."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from annotator.formats.reading import read_picture
from annotator.project import FramePart, Project, StoredFrame, WriteContext
from annotator.project.event_types import ImageBoxesSet
from annotator.project.overview import read_page
from annotator.project.records import storable
from annotator.types import Box2D, BoxKind, Camera, Source
from annotator.types.errors import FormatError, FrameError, StaleRevisionError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.boxes_3d import Importer
from annotator.workflows.importing.frame_finder import FrameFinder, Renamed
from annotator.workflows.importing.picture_labels import PictureLabels, PictureSet
from annotator.workflows.views.follow_image_boxes import view_followers

# Boxes that differ by fewer pixels are the same box, rounded in a file; a box that is drawn again differs by more.
ROUNDED_PX = 0.01


@dataclass(frozen=True)
class OnImage:
    """Boxes for the camera image of a frame.

    Attributes:
        labels: the image in the dataset.
        camera: of the frame; None if it cannot be read.
    """

    frame_id: int
    labels: PictureLabels
    boxes: tuple[Box2D, ...]
    camera: Camera | None


class Stored(Enum):
    """The outcome of storing the boxes of an image."""

    # stored, without replacing boxes of another author
    KEPT = "kept"
    # stored, in place of boxes drawn by another author
    REPLACED = "replaced"
    # not stored: the frame is finalised
    LEFT_ALONE = "left alone"


@dataclass(frozen=True)
class CheckedImages:
    """Images matched with frames, and the others.

    Attributes:
        unmatched: file names of images without a frame.
        unreadable: frames that cannot be read, as `key: reason`.
        renamed: the dataset's only recording, if it was matched with one of another name.
    """

    matched: tuple[OnImage, ...]
    unmatched: tuple[str, ...]
    unreadable: tuple[str, ...]
    renamed: Renamed | None


def checked_images(
    project: Project, dataset: PictureSet, pictures: Sequence[PictureLabels], recording: str | None
) -> CheckedImages:
    """Finds each image's frame, and its boxes in the frame's pixels.

    Args:
        pictures: the camera images of `dataset`.
        recording: name of the only recording to search.

    Raises:
        FormatError: an image fits several recordings, occurs twice, or has another size than the frame; or no image
            has a frame in the project.
        NotFoundError: no such recording.
    """
    matched, unmatched, renamed = _matched(project, dataset, pictures, recording)
    source = FrameSource(project)
    ready, unreadable = [], []
    for picture, stored in matched:
        try:
            camera = source.read(stored).camera
        except FrameError as error:
            # without the frame, a size given by the dataset cannot be checked and is used as it is
            if picture.size_px is not None:
                ready.append(OnImage(stored.id, picture, picture.boxes_on(*picture.size_px), None))
            else:
                unreadable.append(f"{stored.key}: {error}")
            continue
        size_px = (camera.width_px, camera.height_px)
        _require_size(dataset.path, picture, size_px)
        ready.append(OnImage(stored.id, picture, picture.boxes_on(*size_px), camera))
    return CheckedImages(tuple(ready), tuple(unmatched), tuple(unreadable), renamed)


def _matched(
    project: Project, dataset: PictureSet, pictures: Sequence[PictureLabels], recording: str | None
) -> tuple[list[tuple[PictureLabels, StoredFrame]], list[str], Renamed | None]:
    """Returns the images with their frames, the names of images without one, and the renamed recording."""
    path = dataset.path
    frames = FrameFinder(project, recording, {origin.recording for origin in dataset.origins.values()})
    matched: dict[int, tuple[PictureLabels, StoredFrame]] = {}
    unmatched: list[str] = []
    for picture in pictures:
        key, fitting = frames_of(dataset, picture, frames)
        if len(fitting) > 1:
            raise FormatError(
                path,
                f"{picture.file_name}: {len(fitting)} recordings have a frame {key}; choose one of these",
            )
        if not fitting:
            unmatched.append(picture.file_name)
        elif fitting[0].id in matched:
            raise same_frame(path, matched[fitting[0].id][0].file_name, picture.file_name, key)
        else:
            matched[fitting[0].id] = (picture, fitting[0])
    if not matched:
        raise no_frame(path)
    named = (stored for picture, stored in matched.values() if picture.stem in dataset.origins)
    return list(matched.values()), unmatched, frames.renamed(named)


def frames_of(dataset: PictureSet, picture: PictureLabels, frames: FrameFinder) -> tuple[str, list[StoredFrame]]:
    """Returns the key that an image names, and the frames with it: several if several recordings have the key."""
    origin = dataset.origins.get(picture.stem)
    key = picture.stem if origin is None else origin.key
    return key, frames.find(None if origin is None else origin.recording, key)


def same_frame(path: Path, file_name: str, other: str, key: str) -> FormatError:
    """The error for two images of one frame."""
    return FormatError(path, f"{file_name} and {other} both match frame {key}; keep one of them")


def no_frame(path: Path) -> FormatError:
    """The error for a dataset without an image of the project."""
    return FormatError(
        path,
        "none of the dataset's images has a frame in the project; name image files after the frames' keys "
        "(000012.jpg for the frame 000012)",
    )


def _require_size(path: Path, picture: PictureLabels, size_px: tuple[int, int]) -> None:
    """Raises FormatError for boxes of a scaled or cropped copy of the frame's image, which would be misplaced."""
    width_px, height_px = size_px
    if picture.size_px is not None:
        if picture.size_px != size_px:
            raise FormatError(
                path,
                f"{picture.file_name} is {picture.size_px[0]} x {picture.size_px[1]} pixels, but the frame is "
                f"{width_px} x {height_px}; label the image itself, not a scaled copy",
            )
        return
    file = picture.file(path)
    if file is None:
        return
    height, width = read_picture(file)[1].shape[:2]
    # tolerance for the rounding of a scaled copy to whole pixels
    if abs(width * height_px - height * width_px) > max(width_px, height_px):
        raise FormatError(
            path,
            f"{picture.file_name} is {width} x {height} pixels, but the frame is {width_px} x {height_px}: another "
            "aspect ratio; label the whole image, neither cropped nor padded",
        )


def store_on_image(
    project: Project,
    path: Path,
    image: OnImage,
    boxes: Sequence[Box2D],
    kind: BoxKind,
    drawn_from: Sequence[Box2D],
    importer: Importer,
) -> Stored:
    """Stores the boxes of a frame's camera image and updates those on its views, unless the frame is finalised.

    Args:
        path: the dataset, for messages.
        drawn_from: boxes on this image that imported views were rendered from.
    """
    while True:
        page = read_page(project, image.frame_id)
        if page.frame.finalised:
            return Stored.LEFT_ALONE
        before = () if page.image_boxes is None else page.image_boxes.boxes
        with storable(f"{path}: {image.labels.file_name}"):
            on_image = ImageBoxesSet(boxes=tuple(_as_known([*drawn_from, *before], boxes)), box_kind=kind)
        context = WriteContext(page.frame.revision, importer.author, Source.IMPORTED)
        part = FramePart(image.frame_id, [on_image, *view_followers(page, on_image)], context)
        # retried if the frame was changed since it was read
        with suppress(StaleRevisionError):
            project.log.append_to_frames([part], importer.action)
            is_drawn = page.image_boxes is not None and page.image_boxes.source is not Source.IMPORTED
            return Stored.REPLACED if is_drawn and before != on_image.boxes else Stored.KEPT


def _as_known(known: Sequence[Box2D], boxes: Sequence[Box2D]) -> list[Box2D]:
    """Returns the known box for each box that a file has only rounded, so that views rendered from it stay valid."""
    return [next((other for other in known if _is_rounded(box, other)), box) for box in boxes]


def _is_rounded(box: Box2D, known: Box2D) -> bool:
    return box.label == known.label and bool(np.allclose(box.xyxy, known.xyxy, rtol=0, atol=ROUNDED_PX))
