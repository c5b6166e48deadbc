"""2D boxes drawn elsewhere, as COCO files: onto camera images, or onto pictures of pseudo-views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from annotator.formats.coco import CocoImage, read_coco
from annotator.project import Change, Project, StoredFrame
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError
from annotator.workflows.views_out import read_places

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

    Pictures that `annotator views` wrote keep their frame and their place in space; a picture on which nothing was
    drawn is then skipped, since not every view needs to be labelled. Others teach the detector, and no more.

    Raises:
        FormatError: not a COCO file, or a picture is missing or of another size.
        ProjectError: a frame that the project no longer has.
    """
    tally = _Tally(project)
    places = read_places(pictures)
    revisions = {view.view_id: view.revision for view in project.boxes.on_views()}
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
        place = places.get(image.file_name)
        if place is None:
            change = Change(revisions.get(view_id, 0), AUTHOR, Source.IMPORTED)
            project.boxes.set_on_view(view_id, tally.known(image), kind, change)
        elif image.boxes:
            frame = project.frames.find(project.recordings.find(place.recording).id, place.frame)
            change = Change(frame.revision, AUTHOR, Source.IMPORTED)
            project.boxes.set_on_view(
                view_id,
                tally.known(image),
                kind,
                change,
                frame_id=frame.id,
                step=place.step,
                geometry=place.geometry,
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
