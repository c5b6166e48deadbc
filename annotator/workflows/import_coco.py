"""2D boxes drawn elsewhere, as COCO files: onto camera images, or onto pictures of pseudo-views.

A file is looked through before anything is stored, so that one which does not fit changes nothing.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from annotator.formats.coco import CocoImage, read_coco
from annotator.project import Change, Project, StoredFrame
from annotator.project.overview import FramePage, read_page
from annotator.project.payloads import ImageBoxesSet
from annotator.project.records import storable
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.frames import FrameSource
from annotator.workflows.view_followers import view_followers
from annotator.workflows.views_out import ViewPlace, read_places

AUTHOR = "import"
# Files keep two decimals of a pixel or more; nobody draws the same box again so exactly.
ROUNDED_PX = 0.01


@dataclass(frozen=True)
class Imported:
    """What an import brought.

    Attributes:
        pictures: that now have boxes (or are known to be empty).
        boxes: taken over.
        other_classes: boxes left out because the project has no such class, by class name.
        unmatched: file names that belong to no frame of the project.
    """

    pictures: int
    boxes: int
    other_classes: dict[str, int]
    unmatched: tuple[str, ...]


def import_image_boxes(project: Project, path: Path, kind: BoxKind, recording: str | None = None) -> Imported:
    """Boxes on camera images, matched to frames by file name (`000012.jpg` is the frame 000012).

    An image without boxes is taken as one that shows nothing. What follows for the boxes on pseudo-views is done, too:
    those that were drawn from a box that is not there any more go.

    Args:
        kind: what the boxes measure.
        recording: name of the recording that the file names belong to, where several have the same.

    Raises:
        FormatError: not a COCO file; an image that two recordings have, that comes twice, or that has another size
            than the frame; no image of the project, or only boxes of other classes.
    """
    images = read_coco(path)
    tally = _Tally(path, project, images)
    matched, unmatched = _matched(project, path, images, recording)
    _require_sizes(project, path, matched)
    for image, frame in matched:
        page = read_page(project, frame.id)
        with storable(f"{path}: {image.file_name}"):
            on_image = ImageBoxesSet(boxes=tuple(_as_known(page, tally.known(image))), box_kind=kind)
        change = Change(page.frame.revision, AUTHOR, Source.IMPORTED)
        project.log.append(frame.id, [on_image, *view_followers(page, on_image)], change)
    return Imported(tally.pictures, tally.boxes, dict(tally.other), tuple(unmatched))


def _as_known(page: FramePage, boxes: Sequence[Box2D]) -> list[Box2D]:
    """Boxes as the frame has them, where a file has only rounded them: what was drawn from them stays."""
    known = () if page.image_boxes is None else page.image_boxes.boxes
    return [next((other for other in known if _is_rounded(box, other)), box) for box in boxes]


def _is_rounded(box: Box2D, known: Box2D) -> bool:
    return box.label == known.label and bool(np.allclose(box.xyxy, known.xyxy, rtol=0, atol=ROUNDED_PX))


def import_view_boxes(project: Project, path: Path, pictures: Path, kind: BoxKind) -> Imported:
    """Boxes on pseudo-views: the COCO file's images lie in the folder `pictures` and are copied into the project.

    Pictures that `annotator views` wrote keep their frame and their place in space; a picture on which nothing was
    drawn is then skipped, since not every view needs to be labelled. Others teach the detector, and no more.

    Raises:
        FormatError: not a COCO file; a picture is missing, no PNG, there twice, or of another size; or there are only
            boxes of other classes.
        ProjectError: a frame that the project no longer has.
    """
    images = read_coco(path)
    tally = _Tally(path, project, images)
    places = read_places(pictures)
    drawn = [image for image in images if image.boxes or image.file_name not in places]
    files = _checked_pictures(path, pictures, drawn)
    frames = {i.file_name: _frame_of(project, places[i.file_name]) for i in drawn if i.file_name in places}
    _require_different(path, drawn, files, frames)
    revisions = {view.view_id: view.revision for view in project.boxes.on_views() if view.frame_id is None}
    for image, file in zip(drawn, files, strict=True):
        view_id = project.views.store(file.read_bytes())
        place = places.get(image.file_name)
        if place is None:
            change = Change(revisions.get(view_id, 0), AUTHOR, Source.IMPORTED)
            project.boxes.set_on_view(view_id, tally.known(image), kind, change)
            continue
        frame_id = frames[image.file_name].id
        project.boxes.set_on_view(
            view_id,
            tally.known(image),
            kind,
            Change(project.frames.get(frame_id).revision, AUTHOR, Source.IMPORTED),
            frame_id=frame_id,
            step=place.step,
            geometry=place.geometry,
        )
    return Imported(tally.pictures, tally.boxes, dict(tally.other), ())


class _Tally:
    """Counts what is taken over, and what is left out because the project has no such class."""

    def __init__(self, path: Path, project: Project, images: Sequence[CocoImage]) -> None:
        """
        Raises:
            FormatError: there are boxes, but none of a class of the project: every picture would count as empty.
        """
        self._classes = set(project.config.classes)
        self.pictures = self.boxes = 0
        self.other: Counter[str] = Counter()
        found = {box.label for image in images for box in image.boxes}
        if found and not found & self._classes:
            raise FormatError(
                path,
                f"its boxes are of class {', '.join(sorted(found))}, of which the project has none (it has "
                f"{', '.join(project.config.classes)}); rename the categories in the file",
            )

    def known(self, image: CocoImage) -> list[Box2D]:
        self.pictures += 1
        kept = [box for box in image.boxes if box.label in self._classes]
        self.other.update(box.label for box in image.boxes if box.label not in self._classes)
        self.boxes += len(kept)
        return kept


def _matched(
    project: Project, path: Path, images: Sequence[CocoImage], recording: str | None
) -> tuple[list[tuple[CocoImage, StoredFrame]], list[str]]:
    """The images with their frames, and the names of those that have none."""
    frames = _frames_by_key(project, recording)
    matched: dict[int, tuple[CocoImage, StoredFrame]] = {}
    unmatched: list[str] = []
    for image in images:
        key = PurePosixPath(image.file_name).stem
        found = frames.get(key, [])
        if len(found) > 1:
            raise FormatError(path, f"{image.file_name}: {len(found)} recordings have a frame {key}; name one of them")
        if not found:
            unmatched.append(image.file_name)
        elif found[0].id in matched:
            other = matched[found[0].id][0].file_name
            raise FormatError(path, f"{other} and {image.file_name} are both the frame {key}; keep one of them")
        else:
            matched[found[0].id] = (image, found[0])
    if not matched:
        raise FormatError(path, "none of its images is a frame of the project; file names must end in a frame's key")
    return list(matched.values()), unmatched


def _frames_by_key(project: Project, recording: str | None) -> dict[str, list[StoredFrame]]:
    chosen = None if recording is None else [project.recordings.find(recording).id]
    by_key: dict[str, list[StoredFrame]] = {}
    for frame in project.frames.of(chosen):
        by_key.setdefault(frame.key, []).append(frame)
    return by_key


def _require_sizes(project: Project, path: Path, matched: Sequence[tuple[CocoImage, StoredFrame]]) -> None:
    """Boxes on a scaled copy of the image would be taken for boxes on the image."""
    source = FrameSource(project)
    for image, stored in matched:
        try:
            camera = source.read(stored).camera
        except FrameError:
            continue  # there is nothing to compare with; whoever needs the frame will be told what is wrong with it
        if (image.width_px, image.height_px) != (camera.width_px, camera.height_px):
            raise FormatError(
                path,
                f"{image.file_name} is {image.width_px} x {image.height_px} pixels, the frame {camera.width_px} x "
                f"{camera.height_px}; label the image itself, not a scaled copy",
            )


def _checked_pictures(path: Path, pictures: Path, images: Sequence[CocoImage]) -> list[Path]:
    """The file of each image."""
    files: list[Path] = []
    for image in images:
        file = pictures / image.file_name
        if not file.is_file():
            raise FormatError(path, f"{image.file_name} is not in {pictures}; give the folder of the pictures")
        content = file.read_bytes()
        bgr = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
        if bgr is None or not content.startswith(b"\x89PNG"):
            raise FormatError(file, "is no PNG picture that can be read; pseudo-views are kept as PNG")
        height_px, width_px = bgr.shape[:2]
        if (width_px, height_px) != (image.width_px, image.height_px):
            raise FormatError(
                path,
                f"{image.file_name} is {width_px} x {height_px} pixels, the file says {image.width_px} x "
                f"{image.height_px}; label the picture itself, not a scaled copy",
            )
        files.append(file)
    return files


def _require_different(
    path: Path, images: Sequence[CocoImage], files: Sequence[Path], frames: Mapping[str, StoredFrame]
) -> None:
    """The boxes of a picture that comes again would replace the first ones."""
    names: dict[tuple[str, int | None], str] = {}
    for image, file in zip(images, files, strict=True):
        frame = frames.get(image.file_name)
        picture = (hashlib.sha256(file.read_bytes()).hexdigest(), None if frame is None else frame.id)
        if picture in names:
            raise FormatError(path, f"{names[picture]} and {image.file_name} are the same picture; keep one of them")
        names[picture] = image.file_name


def _frame_of(project: Project, place: ViewPlace) -> StoredFrame:
    return project.frames.find(project.recordings.find(place.recording).id, place.frame)
