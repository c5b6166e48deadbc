"""Imports 2D boxes in COCO or YOLO format, for camera images and pseudo-views.

The whole dataset is checked before anything is stored, so an invalid dataset changes nothing.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from annotator.project import Project
from annotator.types import Box2D, BoxKind
from annotator.types.errors import FormatError
from annotator.workflows.importing.pictures import (
    FlatFormat,
    PictureLabels,
    PictureSet,
    Stored,
    checked_images,
    checked_views,
    read_pictures,
    store_on_image,
    store_on_view,
)
from annotator.workflows.importing.placing import NO_NAMES, PROGRAM, Importer, Renamed, how_to_map
from annotator.workflows.importing.values import ImageValues, TakenValues
from annotator.workflows.views.places import ViewPlace, read_places


@dataclass(frozen=True)
class Imported:
    """The result of an import.

    Attributes:
        pictures: number of images that got boxes, or are known to be empty.
        boxes: number of boxes imported.
        other_classes: boxes left out because the project has no such class, by class name.
        unmatched: file names without a frame in the project.
        views: number of pseudo-views among the images.
        unreadable: images left out because their frame, which gives their size, cannot be read; as `key: reason`.
        replaced: number of images whose boxes, drawn by other authors, were replaced.
        finalised: number of images left unchanged because their frame is finalised.
        renamed: the dataset's only recording, if it was matched with one of another name.
        around: number of boxes of the images with boxes that are the rectangles around turned boxes or polygons.
        values: what became of the attributes of boxes and images.
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
    values: TakenValues = field(default_factory=TakenValues)
    around: int = 0


def import_image_boxes(
    project: Project,
    path: Path,
    kind: BoxKind | None,
    recording: str | None = None,
    format: FlatFormat = FlatFormat.COCO,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer = PROGRAM,
    progress: Callable[[int, int], None] | None = None,
) -> Imported:
    """Imports boxes of camera images, matched to frames by `frames.csv`, else by file name (`000012.jpg`: 000012).

    An image without boxes is stored as empty. Attributes of the boxes go to the 3D labels that they show
    (`values.py`). Finalised frames stay unchanged; on all others the boxes replace existing
    ones, and replaced boxes of other authors are counted. If a box is removed, the boxes on the
    pseudo-views that were rendered from it are removed, too. Images listed in a `views.json` beside them are
    pseudo-views, imported as in `import_view_boxes`.

    Args:
        path: a file, or the folder of a dataset.
        kind: what the boxes measure; None = as the dataset says, else silhouettes.
        recording: name of the recording of the file names, if several recordings have such frames.
        names: the project's class of each class of the file; classes that are not listed keep their names.
        progress: called with (images stored, images).

    Raises:
        FormatError: not in this format; an image that fits two recordings, occurs twice, or has another size than the
            frame; no image of the project; only boxes of other classes; or as `import_view_boxes`.
        ProjectError: no such recording, or a view of a frame that the project does not have.
    """
    dataset = read_pictures(format, path)
    places = {folder: read_places(folder) for folder in {picture.folder for picture in dataset.pictures}}
    return _import(
        project,
        dataset,
        places,
        kind,
        recording,
        all_views=False,
        names=names,
        importer=importer,
        progress=progress,
    )


def import_view_boxes(
    project: Project,
    path: Path,
    pictures: Path,
    kind: BoxKind | None,
    format: FlatFormat = FlatFormat.COCO,
    names: Mapping[str, str] = NO_NAMES,
) -> Imported:
    """Imports boxes of pseudo-views; their images in the folder `pictures` are copied into the project.

    Images written by `annotator views` keep their frame and geometry; those without boxes are skipped, since not every
    view needs to be labelled. Other images are used for training only.

    Raises:
        FormatError: not in this format; an image is missing, not PNG, occurs twice, or has another size; or there are
            only boxes of other classes.
        ProjectError: a frame that the project does not have.
    """
    dataset = read_pictures(format, path, pictures)
    return _import(project, dataset, {pictures: read_places(pictures)}, kind, None, all_views=True, names=names)


def _import(
    project: Project,
    dataset: PictureSet,
    places: dict[Path, dict[str, ViewPlace]],
    kind: BoxKind | None,
    recording: str | None,
    all_views: bool,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer = PROGRAM,
    progress: Callable[[int, int], None] | None = None,
) -> Imported:
    tally = _Tally(dataset.path, project, dataset.pictures, names)
    pairs = [(picture, places[picture.folder].get(picture.file_name)) for picture in dataset.pictures]
    on_images = [picture for picture, place in pairs if place is None and not all_views]
    on_views = [
        (picture, place)
        for picture, place in pairs
        if (place is not None and (place.labelled or picture.labels)) or (place is None and all_views)
    ]
    images = checked_images(project, dataset, on_images, recording) if on_images or not on_views else None
    views = checked_views(project, dataset.path, on_views)
    # an imported view was rendered from a box on its image; the file may have rounded that box
    drawn_from: dict[int | None, list[Box2D]] = defaultdict(list)
    for view in views:
        drawn_from[view.frame_id] += [] if view.image_box is None else [view.image_box]
    values, around = ImageValues(project), 0
    for done, image in enumerate(images.matched if images is not None else (), start=1):
        known, base = tally.known(image.boxes), drawn_from[image.frame_id]
        measured = kind or image.labels.box_kind or BoxKind.SILHOUETTE
        stored = store_on_image(project, dataset.path, image, known, measured, base, importer)
        tally.add(image.boxes, stored)
        if stored is not Stored.LEFT_ALONE:
            values.take(image, names, importer)
            around += image.labels.around
        if progress is not None and images is not None:
            progress(done, len(images.matched))
    stored_images = tally.pictures
    revisions = {view.view_id: view.revision for view in project.boxes.on_views() if view.frame_id is None}
    for picture, _ in on_views:
        values.leave_out(picture)
        around += picture.around
    for view in views:
        measured = kind or view.box_kind or BoxKind.SILHOUETTE
        tally.add(view.boxes, store_on_view(project, view, tally.known(view.boxes), measured, revisions))
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
        values.taken,
        around,
    )


class _Tally:
    """Counts imported boxes, and boxes left out because the project has no such class."""

    def __init__(
        self, path: Path, project: Project, pictures: Sequence[PictureLabels], names: Mapping[str, str]
    ) -> None:
        """
        Args:
            names: the project's class of each class of the dataset that has another name.

        Raises:
            FormatError: no box has a class of the project, so every image would be stored as empty.
        """
        self._classes, self._names = set(project.config.classes), names
        self.pictures = self.boxes = 0
        self.other: Counter[str] = Counter()
        self.outcomes: Counter[Stored] = Counter()
        named = {label for picture in pictures for label in picture.labels}
        if named and not {names.get(label, label) for label in named} & self._classes:
            raise FormatError(
                path,
                f"none of the dataset's classes is in the project: the dataset has {', '.join(sorted(named))}, the "
                f"project has {', '.join(project.config.classes)}; {how_to_map(named, project)}",
            )

    def known(self, boxes: Sequence[Box2D]) -> list[Box2D]:
        """Returns the boxes of the project's classes."""
        renamed = [replace(box, label=self._names.get(box.label, box.label)) for box in boxes]
        return [box for box in renamed if box.label in self._classes]

    def add(self, boxes: Sequence[Box2D], stored: Stored) -> None:
        """Counts an image with its boxes, by the outcome of storing them."""
        self.outcomes[stored] += 1
        if stored is Stored.LEFT_ALONE:
            return
        self.pictures += 1
        self.boxes += len(self.known(boxes))
        self.other.update(box.label for box in boxes if self._names.get(box.label, box.label) not in self._classes)
