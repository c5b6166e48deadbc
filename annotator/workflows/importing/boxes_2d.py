"""Imports 2D boxes in COCO or YOLO format, for camera images and pseudo-views.

The whole dataset is checked before anything is stored, so an invalid dataset changes nothing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from annotator.files import read_file
from annotator.formats.frame_names import PictureLabels
from annotator.formats.table import FlatFormat
from annotator.project import FramePart, Project, WriteContext
from annotator.project.changes import ImageBoxesSet
from annotator.project.overview import read_page
from annotator.project.records import storable
from annotator.types import Box2D, BoxKind, Source
from annotator.types.errors import FormatError, StaleRevisionError
from annotator.workflows.importing.pictures import (
    OnImage,
    OnView,
    PictureSet,
    checked_images,
    checked_views,
    read_pictures,
)
from annotator.workflows.importing.placing import AUTHOR, NO_NAMES, PROGRAM, Importer, OwnClasses, how_to_map
from annotator.workflows.importing.report import Become, ImportReport, Note
from annotator.workflows.importing.values import ImageValues
from annotator.workflows.views import ViewPlace, read_places, view_followers


def import_image_boxes(
    project: Project,
    path: Path,
    kind: BoxKind | None,
    recording: str | None = None,
    format: FlatFormat = FlatFormat.COCO,
    names: Mapping[str, str] = NO_NAMES,
    importer: Importer = PROGRAM,
    progress: Callable[[int, int], None] | None = None,
) -> ImportReport:
    """Imports boxes of camera images, matched to frames by `frames.csv`, else by file name (`000012.jpg`: 000012).

    An image without boxes is stored as empty. Attributes of the boxes go to the 3D labels that they show
    (`values.py`). Finalised frames stay unchanged; on all others the boxes replace existing
    ones, and replaced boxes of other authors are counted. If a box is removed, the boxes on the
    pseudo-views that were rendered from it are removed, too. Images listed in a `views.json` beside them are
    pseudo-views, imported as in `import_view_boxes`.

    Args:
        kind: what the boxes measure; None = as the dataset says, else silhouettes.
        recording: name of the recording of the file names, if several recordings have such frames.
        names: the project's class of each class of the file; classes that are not listed keep their names.
        progress: called with (images stored, images).
    """
    dataset = read_pictures(format, path)
    places = {folder: read_places(folder) for folder in {picture.folder for picture in dataset.pictures}}
    pairs = [(picture, places[picture.folder].get(picture.file_name)) for picture in dataset.pictures]
    on_images = [picture for picture, place in pairs if place is None]
    on_views = [
        (picture, place) for picture, place in pairs if place is not None and (place.labelled or picture.labels)
    ]
    return _Import(project, dataset, kind, names, importer).run(on_images, on_views, recording, progress)


def import_view_boxes(
    project: Project,
    path: Path,
    pictures: Path,
    kind: BoxKind | None,
    format: FlatFormat = FlatFormat.COCO,
    names: Mapping[str, str] = NO_NAMES,
) -> ImportReport:
    """Imports boxes of pseudo-views; their images in the folder `pictures` are copied into the project.

    Images written by `annotator views` keep their frame and geometry; those without boxes are skipped, since not every
    view needs to be labelled. Other images are used for training only.
    """
    dataset, places = read_pictures(format, path, pictures), read_places(pictures)
    pairs = [(picture, places.get(picture.file_name)) for picture in dataset.pictures]
    on_views = [(picture, place) for picture, place in pairs if place is None or place.labelled or picture.labels]
    return _Import(project, dataset, kind, names, PROGRAM).run([], on_views, None, None)


class _Import:
    """One import of the boxes of a dataset."""

    def __init__(
        self,
        project: Project,
        dataset: PictureSet,
        kind: BoxKind | None,
        names: Mapping[str, str],
        importer: Importer,
    ) -> None:
        self._project, self._dataset, self._kind = project, dataset, kind
        self._own, self._importer = OwnClasses(project.config.classes, names), importer
        self._classes = project.config.classes
        self._report = ImportReport(Become.FLAT, self._classes)
        theirs = {label for picture in dataset.pictures for label in picture.labels}
        if theirs and not any(map(self._own.of, theirs)):
            raise FormatError(
                dataset.path,
                f"none of the dataset's classes is in the project: the dataset has {', '.join(sorted(theirs))}, the "
                f"project has {', '.join(self._classes)}; {how_to_map(theirs, project)}",
            )

    def run(
        self,
        on_images: Sequence[PictureLabels],
        on_views: Sequence[tuple[PictureLabels, ViewPlace | None]],
        recording: str | None,
        progress: Callable[[int, int], None] | None,
    ) -> ImportReport:
        """Checks all images, then stores their boxes."""
        project, dataset, report = self._project, self._dataset, self._report
        images: Sequence[OnImage] = ()
        if on_images or not on_views:
            images, placed, unreadable = checked_images(project, dataset, on_images, recording)
            report.add_all(Note.UNMATCHED_IMAGE, placed.unmatched)
            report.add_all(Note.UNREADABLE, unreadable)
            if placed.renamed is not None:
                report.add(Note.RENAMED, of=str(placed.renamed))
        views = checked_views(project, dataset.path, on_views)
        # an imported view was rendered from a box on its image; the file may have rounded that box
        drawn_from: dict[int | None, list[Box2D]] = defaultdict(list)
        for view in views:
            drawn_from[view.frame_id] += [] if view.image_box is None else [view.image_box]
        values = ImageValues(project, report)
        for done, image in enumerate(images, start=1):
            known = self._known(image.boxes)
            if self._count(image.boxes, known, self._store_on_image(image, known, drawn_from[image.frame_id])):
                report.frames += 1
                values.take(image, self._own, self._importer)
                report.add(Note.AROUND, image.labels.around)
            if progress is not None:
                progress(done, len(images))
        revisions = {view.view_id: view.revision for view in project.boxes.on_views() if view.frame_id is None}
        for picture, _ in on_views:
            values.leave_out(picture)
            report.add(Note.AROUND, picture.around)
        for view in views:
            known = self._known(view.boxes)
            report.views += self._count(view.boxes, known, self._store_on_view(view, known, revisions))
        values.report_left_out()
        return report

    def _known(self, boxes: Sequence[Box2D]) -> list[Box2D]:
        """Returns the boxes of the project's classes."""
        own = ((box, self._own.of(box.label)) for box in boxes)
        return [box if label == box.label else replace(box, label=label) for box, label in own if label is not None]

    def _count(self, boxes: Sequence[Box2D], known: Sequence[Box2D], replaced: bool | None) -> bool:
        """Counts the boxes of an image; returns whether they were stored. `replaced` as from `_store_on_image`."""
        if replaced is None:
            self._report.add(Note.FINALISED)
            return False
        self._report.add(Note.REPLACED, replaced)
        self._report.boxes.update(box.label for box in known)
        self._report.add_all(Note.OTHER_CLASS, (box.label for box in boxes if self._own.of(box.label) is None))
        return True

    def _store_on_image(self, image: OnImage, boxes: Sequence[Box2D], drawn_from: Sequence[Box2D]) -> bool | None:
        """Stores the boxes of a frame's camera image and updates those on its views, unless the frame is finalised.

        Args:
            drawn_from: boxes on this image that imported views were rendered from.

        Returns:
            Whether it has replaced boxes that another author drew; None = nothing was stored.
        """
        kind = self._kind or image.labels.box_kind or BoxKind.SILHOUETTE
        while True:
            page = read_page(self._project, image.frame_id)
            if page.frame.finalised:
                return None
            before = () if page.image_boxes is None else page.image_boxes.boxes
            with storable(f"{self._dataset.path}: {image.labels.file_name}"):
                on_image = ImageBoxesSet(
                    boxes=tuple(_as_known([*drawn_from, *before], box) for box in boxes), box_kind=kind
                )
            context = WriteContext(page.frame.revision, self._importer.author, Source.IMPORTED)
            part = FramePart(image.frame_id, [on_image, *view_followers(page, on_image)], context)
            # retried if the frame was changed since it was read
            with suppress(StaleRevisionError):
                self._project.log.append_to_frames([part], self._importer.action)
                is_drawn = page.image_boxes is not None and page.image_boxes.source is not Source.IMPORTED
                return is_drawn and before != on_image.boxes

    def _store_on_view(self, view: OnView, boxes: Sequence[Box2D], revisions: Mapping[str, int]) -> bool | None:
        """Copies the image into the project and stores its boxes, unless the frame is finalised.

        Args:
            revisions: revisions of the project's views without a frame, by id.

        Returns:
            As `_store_on_image`.
        """
        project, content = self._project, read_file(view.file)
        kind = self._kind or view.box_kind or BoxKind.SILHOUETTE
        while True:
            frame = None if view.frame_id is None else project.frames.get(view.frame_id)
            if frame is not None and frame.finalised:
                return None
            view_id = project.views.store(content)
            revision = revisions.get(view_id, 0) if frame is None else frame.revision
            context = WriteContext(revision, AUTHOR, Source.IMPORTED)
            try:
                project.boxes.set_on_view(
                    view_id, boxes, kind, context, frame_id=view.frame_id, step=view.step, geometry=view.geometry
                )
                return False
            except StaleRevisionError:
                # retried if the frame was changed since it was read; only another import changes a view without a frame
                if frame is None:
                    raise


# Boxes that differ by fewer pixels are the same box, rounded in a file; a box that is drawn again differs by more.
ROUNDED_PX = 0.01


def _as_known(known: Sequence[Box2D], box: Box2D) -> Box2D:
    """Returns the known box for one that a file has only rounded, so that views rendered from it stay valid."""
    same = (other for other in known if other.label == box.label)
    return next((other for other in same if np.allclose(box.xyxy, other.xyxy, rtol=0, atol=ROUNDED_PX)), box)
