"""Labelled images of COCO and YOLO datasets, and the project's frames and pseudo-views that they show."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from annotator.files import open_file
from annotator.formats.coco import dataset_folder, read_coco_dataset
from annotator.formats.frame_names import FrameOrigin, PictureLabels, read_frames
from annotator.formats.reading import OnFault, raise_fault, read_picture
from annotator.formats.table import FlatFormat
from annotator.formats.yolo import read_yolo
from annotator.image_bytes import (
    PNG_SIGNATURE,
    UPRIGHT,
    Size,
    box_as_stored,
    declared_size,
    described,
    orientation_of,
    turned_size,
)
from annotator.project import Project, ViewGeometry
from annotator.text import stem_of
from annotator.types import Box2D, BoxKind, Camera, Frame
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.importing.placing import Matched, Place, match
from annotator.workflows.views import ViewPlace


@dataclass(frozen=True, eq=False)
class PictureSet:
    """All labelled images of a file or dataset, read and checked.

    Attributes:
        path: the file or folder that was read.
        pictures: the images in its order.
        origins: the frames of camera images from `frames.csv`, by stem.
    """

    path: Path
    pictures: tuple[PictureLabels, ...]
    origins: dict[str, FrameOrigin]


def read_pictures(
    format: FlatFormat, path: Path, folder: Path | None = None, on_fault: OnFault = raise_fault
) -> PictureSet:
    """Reads the labelled images at `path`."""
    if format is FlatFormat.COCO:
        root, pictures = dataset_folder(path), read_coco_dataset(path, on_fault)
    else:
        root, pictures = path if path.is_dir() else path.parent, read_yolo(path, on_fault)
    if folder is not None:
        pictures = [replace(each, folder=folder, file_name=_of_image(each.file_name)) for each in pictures]
    return PictureSet(path, tuple(pictures), read_frames(root))


def _of_image(name: str) -> str:
    """Labels without an image belong to a pseudo-view, which is a PNG file."""
    return f"{stem_of(name)}.png" if name.endswith(".txt") else name


# Of a JPEG file, this holds the segment with its EXIF orientation, which has at most 64 KiB and is one of the first.
HEAD_BYTES = 1 << 18


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


def checked_images(
    project: Project, dataset: PictureSet, pictures: Sequence[PictureLabels], recording: str | None
) -> tuple[list[OnImage], Matched[PictureLabels], list[str]]:
    """Finds each image's frame, and its boxes in the frame's pixels.

    Returns:
        The images, all matches, and the frames that cannot be read, as `key: reason`.
    """
    placed = placed_pictures(project, dataset, pictures, recording).require_clear(dataset.path)
    source = FrameSource(project)
    ready, unreadable = [], []
    for picture, stored in placed.matched:
        try:
            frame = source.read(stored)
        except FrameError as error:
            # without the frame, a size given by the dataset cannot be checked and is used as it is
            if picture.size_px is not None:
                ready.append(OnImage(stored.id, picture, picture.boxes_on(*picture.size_px), None))
            else:
                unreadable.append(f"{stored.key}: {error}")
            continue
        ready.append(OnImage(stored.id, picture, _boxes_on(dataset.path, picture, frame), frame.camera))
    return ready, placed, unreadable


def placed_pictures(
    project: Project, dataset: PictureSet, pictures: Sequence[PictureLabels], recording: str | None
) -> Matched[PictureLabels]:
    """Finds the frames of images; some may fit several recordings. Arguments as `checked_images`."""
    places = []
    for picture in pictures:
        origin = dataset.origins.get(picture.stem)
        at, key = (None, picture.stem) if origin is None else (origin.recording, origin.key)
        places.append(Place(picture, picture.file_name, at, key))
    nothing = FormatError(
        dataset.path,
        "none of the dataset's images has a frame in the project; name image files after the frames' keys "
        "(000012.jpg for the frame 000012)",
    )
    return match(project, dataset.path, places, recording, nothing)


def _boxes_on(path: Path, picture: PictureLabels, frame: Frame) -> tuple[Box2D, ...]:
    """Returns an image's boxes in the frame's pixels, also if its EXIF orientation was applied to the boxes only."""
    size_px = (frame.camera.width_px, frame.camera.height_px)
    file = picture.file(path)
    said, orientation, is_as_stored = picture.size_px, frame.exif_orientation, True
    if file is not None:
        content, (height, width) = _content(file, is_decoded=said is None)
        own = orientation_of(content)
        if said is None and own == UPRIGHT:
            said = (width, height)
        if orientation == UPRIGHT:
            orientation, is_as_stored = own, declared_size(content) == size_px
    shown_px = turned_size(orientation, size_px)
    is_exact = picture.size_px is not None
    fits, fits_shown = (said is not None and _fits(said, size, is_exact) for size in (size_px, shown_px))
    if orientation != UPRIGHT and (said is None or (fits_shown and (fits or not is_as_stored))):
        raise FormatError(
            path,
            f"{picture.file_name} has the {described(orientation)}, and its boxes may be for the image as stored or as "
            "shown; save the recording's images without this tag and label them, or give the boxes in COCO's format "
            "with the images' sizes, if these differ",
        )
    if orientation != UPRIGHT and fits_shown:
        return tuple(box_as_stored(box, orientation, size_px) for box in picture.boxes_on(*shown_px))
    if said is not None and not fits:
        remedy = "label the image itself, not a scaled copy"
        if not is_exact:
            remedy = "another aspect ratio; label the whole image, neither cropped nor padded"
        raise FormatError(
            path,
            f"{picture.file_name} is {said[0]} x {said[1]} pixels, but the frame is {size_px[0]} x {size_px[1]}"
            f"{'; ' if is_exact else ': '}{remedy}",
        )
    return picture.boxes_on(*size_px)


def _content(file: Path, is_decoded: bool) -> tuple[bytes, tuple[int, int]]:
    """Returns an image file's bytes, and the height and width as shown; if not decoded, its head, and (0, 0)."""
    if is_decoded:
        content, bgr = read_picture(file)
        return content, (bgr.shape[0], bgr.shape[1])
    try:
        with open_file(file) as opened:
            return opened.read(HEAD_BYTES), (0, 0)
    except OSError:  # its size is known without it
        return b"", (0, 0)


def _fits(size: Size, other: Size, is_exact: bool) -> bool:
    """True for the same size, or for the proportions of a copy that was scaled to whole pixels."""
    if is_exact:
        return size == other
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(other)


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
    """Checks the views of a dataset and finds their frames."""
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
