"""2D boxes drawn elsewhere, in COCO or YOLO form: onto camera images, and onto pictures of pseudo-views.

A dataset is looked through before anything is stored, so that one which does not fit changes nothing.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from annotator.project import Project
from annotator.types import Box2D, BoxKind
from annotator.types.errors import FormatError
from annotator.workflows.importing.frame_finder import Renamed
from annotator.workflows.importing.image_boxes import Stored, checked_images, store_on_image
from annotator.workflows.importing.picture_labels import FlatFormat, PictureLabels, PictureSet, read_pictures
from annotator.workflows.importing.view_boxes import checked_views, store_on_view
from annotator.workflows.views_out import ViewPlace, read_places


@dataclass(frozen=True)
class Imported:
    """What an import brought.

    Attributes:
        pictures: that now have boxes (or are known to be empty).
        boxes: taken over.
        other_classes: boxes left out because the project has no such class, by class name.
        unmatched: file names that belong to no frame of the project.
        views: how many of the pictures are pseudo-views.
        unreadable: images whose frame cannot be read, which alone knows their size, as `key: reason`.
        replaced: images whose boxes somebody else had drawn, and which have those of the dataset now.
        finalised: pictures that were left alone because their frame is finalised.
        renamed: the dataset's only recording, where it was taken for one of another name.
    """

    pictures: int
    boxes: int
    other_classes: dict[str, int]
    unmatched: tuple[str, ...] = ()
    views: int = 0
    unreadable: tuple[str, ...] = ()
    replaced: int = 0
    finalised: int = 0
    renamed: Renamed | None = None


def import_image_boxes(
    project: Project,
    path: Path,
    kind: BoxKind,
    recording: str | None = None,
    format: FlatFormat = FlatFormat.COCO,
) -> Imported:
    """Boxes on camera images, matched to frames by `frames.csv`, else by file name (`000012.jpg` is the frame 000012).

    An image without boxes is taken as one that shows nothing. Finalised frames are left alone; on all others the boxes
    replace those that were there, and it is told where somebody else had drawn them. What follows for the boxes on
    pseudo-views is done, too: those that were drawn from a box that is not there any more go. Pictures that
    `views.json` beside them names are pseudo-views, and taken over as `import_view_boxes` does.

    Args:
        path: a file, or the folder of a dataset.
        kind: what the boxes measure.
        recording: name of the recording that the file names belong to, where several have the same.

    Raises:
        FormatError: not of that format; an image that two recordings have, that comes twice, or that has another size
            than the frame; no image of the project, or only boxes of other classes; or as `import_view_boxes`.
        ProjectError: no such recording, or a view of a frame that the project does not have.
    """
    found = read_pictures(format, path)
    places = {folder: read_places(folder) for folder in {picture.folder for picture in found.pictures}}
    return _import(project, found, places, kind, recording, all_views=False)


def import_view_boxes(
    project: Project, path: Path, pictures: Path, kind: BoxKind, format: FlatFormat = FlatFormat.COCO
) -> Imported:
    """Boxes on pseudo-views, whose pictures lie in the folder `pictures` and are copied into the project.

    Pictures that `annotator views` wrote keep their frame and their place in space; a picture on which nothing was
    drawn is then skipped, since not every view needs to be labelled. Others teach the detector, and no more.

    Raises:
        FormatError: not of that format; a picture is missing, no PNG, there twice, or of another size; or there are
            only boxes of other classes.
        ProjectError: a frame that the project no longer has.
    """
    found = read_pictures(format, path, pictures)
    return _import(project, found, {pictures: read_places(pictures)}, kind, None, all_views=True)


def _import(
    project: Project,
    found: PictureSet,
    places: dict[Path, dict[str, ViewPlace]],
    kind: BoxKind,
    recording: str | None,
    all_views: bool,
) -> Imported:
    tally = _Tally(found.path, project, found.pictures)
    pairs = [(picture, places[picture.folder].get(picture.file_name)) for picture in found.pictures]
    on_images = [picture for picture, place in pairs if place is None and not all_views]
    on_views = [
        (picture, place)
        for picture, place in pairs
        if (place is not None and (place.labelled or picture.labels)) or (place is None and all_views)
    ]
    images = checked_images(project, found, on_images, recording) if on_images or not on_views else None
    views = checked_views(project, found.path, on_views)
    # a view that comes along was drawn from the box on its image, which a file may have rounded
    drawn_from: dict[int | None, list[Box2D]] = defaultdict(list)
    for view in views:
        drawn_from[view.frame_id] += [] if view.image_box is None else [view.image_box]
    for image in images.matched if images is not None else ():
        known, base = tally.known(image.boxes), drawn_from[image.frame_id]
        tally.add(image.boxes, store_on_image(project, found.path, image, known, kind, base))
    stored_images = tally.pictures
    revisions = {view.view_id: view.revision for view in project.boxes.on_views() if view.frame_id is None}
    for view in views:
        tally.add(view.boxes, store_on_view(project, view, tally.known(view.boxes), kind, revisions))
    return Imported(
        tally.pictures,
        tally.boxes,
        dict(tally.other),
        images.unmatched if images is not None else (),
        tally.pictures - stored_images,
        images.unreadable if images is not None else (),
        tally.outcomes[Stored.REPLACED],
        tally.outcomes[Stored.LEFT_ALONE],
        images.renamed if images is not None else None,
    )


class _Tally:
    """Counts what is taken over, and what is left out because the project has no such class."""

    def __init__(self, path: Path, project: Project, pictures: Sequence[PictureLabels]) -> None:
        """
        Raises:
            FormatError: there are boxes, but none of a class of the project: every picture would count as empty.
        """
        self._classes = set(project.config.classes)
        self.pictures = self.boxes = 0
        self.other: Counter[str] = Counter()
        self.outcomes: Counter[Stored] = Counter()
        found = {label for picture in pictures for label in picture.labels}
        if found and not found & self._classes:
            raise FormatError(
                path,
                f"its boxes are of class {', '.join(sorted(found))}, of which the project has none (it has "
                f"{', '.join(project.config.classes)}); rename the categories in the file",
            )

    def known(self, boxes: Sequence[Box2D]) -> list[Box2D]:
        """Those of the project's classes."""
        return [box for box in boxes if box.label in self._classes]

    def add(self, boxes: Sequence[Box2D], stored: Stored) -> None:
        """Counts a picture with its boxes, by what became of them."""
        self.outcomes[stored] += 1
        if stored is Stored.LEFT_ALONE:
            return
        self.pictures += 1
        self.boxes += len(self.known(boxes))
        self.other.update(box.label for box in boxes if box.label not in self._classes)
