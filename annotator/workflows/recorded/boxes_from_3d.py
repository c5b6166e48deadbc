"""2D training boxes from known 3D boxes (RCV paper, Fig. 5), on camera images and on the first two steps' views.

Only the 2D boxes are stored, as imported boxes around the whole object (`BoxKind.BOX`). The frames stay without 3D
labels, so the detectors learn from 2D boxes alone, as in the paper.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from annotator.project import Project, StoredFrame, WriteContext
from annotator.project.event_types import ImageBoxesSet, Payload, ViewBoxesRemoved, ViewBoxesSet
from annotator.project.overview import FramePage, read_page
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import KnownFrame, boxes_of_known
from annotator.types import BoxKind, Source
from annotator.types.errors import ConfigError, FormatError, FrameError, StaleRevisionError
from annotator.types.messages import amount
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.recorded.frame_subset import share_of
from annotator.workflows.recorded.labelled_frames import KnownLabels
from annotator.workflows.settings import rcv_config
from annotator.workflows.views.places import geometry_of

# A later import replaces only the boxes of this author.
AUTHOR = "import of 3D boxes"


@dataclass(frozen=True)
class _Stored:
    """The views of a frame whose boxes are stored, and the number of views that keep boxes of another author."""

    views: tuple[ViewBoxesSet, ...]
    others: int


@dataclass
class BoxesFrom3d:
    """Counts of the 2D boxes made from 3D boxes.

    Attributes:
        chosen: frames chosen for the import.
        frames: frames whose 2D boxes are stored now, including those without objects of the classes.
        image_boxes: boxes on their camera images, by class.
        objects: objects with boxes on all four views, by class.
        views: views whose boxes are stored now; objects with the same image box share their first views.
        view_boxes: boxes on these views; a view has the boxes of all objects that it shows.
        without_views: objects on the image with too few points for views, by class.
        outside: objects outside the image, by class.
        hidden: objects occluded in the image, by class.
        other_classes: objects left out because the project does not have their class, by class.
        not_reviewed: boxes on `frames` left out because they are not accepted in the dataset.
        drawn: frames not changed because they have drawn image boxes or are finalised.
        others_views: views of `frames` that keep the boxes of another author, drawn or imported.
        in_all: frames of the project whose image boxes come from such imports, earlier ones included.
        unreadable: frames whose data or label file could not be read, as `key: reason`.
    """

    chosen: int = 0
    frames: int = 0
    image_boxes: Counter[str] = field(default_factory=Counter)
    objects: Counter[str] = field(default_factory=Counter)
    views: int = 0
    view_boxes: int = 0
    without_views: Counter[str] = field(default_factory=Counter)
    outside: Counter[str] = field(default_factory=Counter)
    hidden: Counter[str] = field(default_factory=Counter)
    other_classes: Counter[str] = field(default_factory=Counter)
    not_reviewed: int = 0
    drawn: int = 0
    others_views: int = 0
    in_all: int = 0
    unreadable: list[str] = field(default_factory=list)

    def add(self, known: KnownFrame, stored: _Stored) -> None:
        """Counts a frame whose boxes are stored."""
        self.frames += 1
        self.image_boxes.update(box.label for box in known.on_image)
        self.objects.update(item.image_box.label for item in known.objects)
        self.views += len(stored.views)
        self.view_boxes += sum(len(view.boxes) for view in stored.views)
        self.others_views += stored.others
        for counter, labels in (
            (self.without_views, known.without_views),
            (self.outside, known.outside),
            (self.hidden, known.hidden),
        ):
            counter.update(labels)


def boxes_from_3d(
    project: Project,
    labels: KnownLabels,
    *,
    fraction: float = 1.0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> BoxesFrom3d:
    """Turns known 3D boxes into 2D boxes of the project, frame by frame. Boxes of an earlier import are replaced.

    A frame is stored whole or not at all. Frames with drawn image boxes, finalised frames, views with boxes of another
    author, and frames chosen only by an earlier import are not changed.

    Args:
        labels: the labelled frames and their objects.
        fraction: share of these frames, as for `share_of`.
        seed: seed of that choice.
        progress: called with (frames done, frames chosen).

    Raises:
        ConfigError: `fraction` is out of range, or no frame has a box of the project's classes.
        FormatError: a label file that holds several frames cannot be read.
        RecordingError: a recording is missing or cannot be read.
    """
    source, config = FrameSource(project), rcv_config(project)
    recordings = {recording.id: recording.name for recording in project.recordings.all()}
    names = [(recordings[stored.recording_id], stored.key) for stored in labels.frames]
    share = share_of(names, fraction, seed)
    chosen = [stored for stored, name in zip(labels.frames, names, strict=True) if name in share]
    skipped_errors = (FrameError, FormatError) if labels.one_file_a_frame else (FrameError,)
    counts = BoxesFrom3d(chosen=len(chosen))
    for number, stored in enumerate(chosen, 1):
        try:
            _convert(project, stored, source, labels, config, counts)
        except skipped_errors as error:
            counts.unreadable.append(f"{stored.key}: {error}")
        if progress is not None:
            progress(number, len(chosen))
    _require_boxes(project, counts)
    counts.in_all = sum(boxes.author == AUTHOR for boxes in project.boxes.on_images())
    return counts


def _convert(
    project: Project,
    stored: StoredFrame,
    source: FrameSource,
    labels: KnownLabels,
    config: RcvConfig,
    counts: BoxesFrom3d,
) -> None:
    if _is_drawn(read_page(project, stored.id)):  # checked first, before the slow steps
        counts.drawn += 1
        return
    frame = source.read(stored)
    truths = labels.truths(stored, frame)
    settings = project.config
    counts.other_classes.update(t.label for t in truths if t.label not in settings.classes)
    chosen = [truth for truth in truths if truth.label in settings.classes]
    orientation = orientation_for(settings.settings.rotation, frame)
    known = boxes_of_known(frame, chosen, config.model_copy(update={"orientation": orientation}))
    result = _store(project, stored.id, known)
    if result is None:
        counts.drawn += 1
    else:
        counts.add(known, result)
        counts.not_reviewed += labels.not_reviewed(stored)


def _is_drawn(page: FramePage) -> bool:
    return page.frame.finalised or (page.image_boxes is not None and page.image_boxes.author != AUTHOR)


def _store(project: Project, frame_id: int, known: KnownFrame) -> _Stored | None:
    """Stores a frame's boxes; None if it has drawn boxes by now."""
    on_image = ImageBoxesSet(boxes=known.on_image, box_kind=BoxKind.BOX)
    # two objects with the same image box share their first views, and so the boxes on them
    entries = {entry.view: entry for entry in _view_boxes(project, known)}
    while True:
        page = read_page(project, frame_id)
        if _is_drawn(page):
            return None
        others = {view.view_id for view in page.view_boxes if view.author != AUTHOR} & entries.keys()
        new = {view_id: entry for view_id, entry in entries.items() if view_id not in others}
        payloads, result = _changes(page, on_image, new), _Stored(tuple(new.values()), len(others))
        if not payloads:
            return result
        # stale if the frame has changed since it was read, e.g. by an automatic pass: try again
        with suppress(StaleRevisionError):
            project.log.append(frame_id, payloads, WriteContext(page.frame.revision, AUTHOR, Source.IMPORTED))
            return result


def _view_boxes(project: Project, known: KnownFrame) -> list[ViewBoxesSet]:
    return [
        ViewBoxesSet(
            view=project.views.store(known_view.view.rgb),
            boxes=known_view.boxes,
            box_kind=BoxKind.BOX,
            step=known_view.step,
            geometry=geometry_of(known_view.view, item.image_box),
        )
        for item in known.objects
        for known_view in item.views
    ]


def _changes(page: FramePage, on_image: ImageBoxesSet, entries: Mapping[str, ViewBoxesSet]) -> list[Payload]:
    """Returns the events that set these boxes on a frame, and remove those of an earlier import."""
    payloads: list[Payload] = []
    if page.image_boxes is None or page.image_boxes.boxes != on_image.boxes:
        payloads.append(on_image)
    present = {view.view_id: view for view in page.view_boxes}
    for view_id, entry in entries.items():
        view = present.get(view_id)
        if view is None or (view.boxes, view.step, view.geometry) != (entry.boxes, entry.step, entry.geometry):
            payloads.append(entry)
    stale = [view.view_id for view in page.view_boxes if view.author == AUTHOR and view.view_id not in entries]
    return payloads + [ViewBoxesRemoved(view=view_id) for view_id in stale]


def _require_boxes(project: Project, counts: BoxesFrom3d) -> None:
    if counts.image_boxes or counts.drawn:
        return
    others = ", ".join(sorted(counts.other_classes)) or "none"
    unreadable = "".join(f"\n  unreadable: {line}" for line in counts.unreadable)
    raise ConfigError(
        f"{amount(counts.chosen, 'frame')} without a box of {', '.join(project.config.classes)} (other classes there: "
        f"{others}); add these to the project with `annotator classes add`, or map them to its own, as in "
        f"--classes {min(counts.other_classes, default='Car')}={project.config.classes[0]}{unreadable}"
    )
