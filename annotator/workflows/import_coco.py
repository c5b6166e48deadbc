"""2D boxes drawn elsewhere, as COCO files: onto camera images, or onto pictures of pseudo-views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from annotator.formats.coco import CocoImage, read_coco
from annotator.project.frames import StoredFrame
from annotator.project.project import Project
from annotator.project.writing import Change
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError

AUTHOR = "import"


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

    Args:
        kind: what the boxes measure.
        recording: name of the recording that the file names belong to, where several have the same.

    Raises:
        FormatError: not a COCO file, an image that two recordings have, or no image of the project.
    """
    frames = _frames_by_key(project, recording)
    unmatched: list[str] = []
    tally = _Tally(project)
    for image in read_coco(path):
        key = PurePosixPath(image.file_name).stem
        found = frames.get(key, [])
        if len(found) > 1:
            raise FormatError(path, f"{image.file_name}: {len(found)} recordings have a frame {key}; name one of them")
        if not found:
            unmatched.append(image.file_name)
            continue
        boxes = tally.known(image)
        change = Change(project.frames.get(found[0].id).revision, AUTHOR, Source.IMPORTED)
        project.boxes.set_on_image(found[0].id, boxes, kind, change)
    if tally.pictures == 0:
        raise FormatError(path, "none of its images is a frame of the project; file names must end in a frame's key")
    return Imported(tally.pictures, tally.boxes, tally.other, tuple(unmatched))


def import_view_boxes(project: Project, path: Path, pictures: Path, kind: BoxKind) -> Imported:
    """Boxes on pseudo-views: the COCO file's images lie in the folder `pictures` and are copied into the project.

    A picture that the project knows already (`annotator views` writes such) keeps its frame and its place in space.

    Raises:
        FormatError: not a COCO file, or a picture is missing or of another size.
    """
    tally = _Tally(project)
    known = {view.view_id: view for view in project.boxes.on_views()}
    for image in read_coco(path):
        file = pictures / image.file_name
        if not file.is_file():
            raise FormatError(path, f"{image.file_name} is not in {pictures}; give the folder of the pictures")
        view_id = project.views.store(file.read_bytes())
        height_px, width_px = project.views.load(view_id).shape[:2]
        if (width_px, height_px) != (image.width_px, image.height_px):
            raise FormatError(
                path,
                f"{image.file_name} is {width_px} x {height_px} pixels, the file says {image.width_px} x "
                f"{image.height_px}; label the picture itself, not a scaled copy",
            )
        boxes = tally.known(image)
        view = known.get(view_id)
        if view is None or view.frame_id is None:
            change = Change(0 if view is None else view.revision, AUTHOR, Source.IMPORTED)
            project.boxes.set_on_view(view_id, boxes, kind, change)
            continue
        change = Change(project.frames.get(view.frame_id).revision, AUTHOR, Source.IMPORTED)
        project.boxes.set_on_view(
            view_id, boxes, kind, change, frame_id=view.frame_id, step=view.step, geometry=view.geometry
        )
    return Imported(tally.pictures, tally.boxes, tally.other, ())


class _Tally:
    """Counts what is taken over, and what is left out because the project has no such class."""

    def __init__(self, project: Project) -> None:
        self._classes = set(project.config.classes)
        self.pictures = self.boxes = 0
        self.other: dict[str, int] = {}

    def known(self, image: CocoImage) -> Sequence[Box2D]:
        self.pictures += 1
        kept = [box for box in image.boxes if box.label in self._classes]
        for box in image.boxes:
            if box.label not in self._classes:
                self.other[box.label] = self.other.get(box.label, 0) + 1
        self.boxes += len(kept)
        return kept


def _frames_by_key(project: Project, recording: str | None) -> dict[str, list[StoredFrame]]:
    chosen = None if recording is None else [project.recordings.find(recording).id]
    by_key: dict[str, list[StoredFrame]] = {}
    for frame in project.frames.of(chosen):
        by_key.setdefault(frame.key, []).append(frame)
    return by_key
