"""2D training boxes from known 3D boxes (RCV paper, Fig. 5): on camera images and on the first two steps' views.

Only the 2D boxes are kept, as imported ones that measure the whole object (`BoxKind.BOX`); the frames stay without 3D
labels. So the detectors learn what the paper's did, from 2D boxes alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from annotator.project import Change, Project, StoredFrame
from annotator.project.overview import FramePage, read_page
from annotator.project.payloads import ImageBoxesSet, Payload, ViewBoxesRemoved, ViewBoxesSet
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import KnownFrame, boxes_of_known
from annotator.types import BoxKind, Source
from annotator.types.errors import ConfigError, FormatError, FrameError, StaleRevisionError
from annotator.workflows.frame_share import share_of
from annotator.workflows.frames import FrameSource, orientation_for
from annotator.workflows.known_labels import KnownLabels
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.views_out import geometry_of

# Boxes of this author are replaced by a later import, those of all others are left alone.
AUTHOR = "import of 3D boxes"


@dataclass(frozen=True)
class _Kept:
    """A frame's views that carry their boxes now, and the number of those that keep somebody else's."""

    views: tuple[ViewBoxesSet, ...]
    others: int


@dataclass
class BoxesFrom3d:
    """What was made of the 3D boxes.

    Attributes:
        chosen: frames that were looked at.
        frames: whose 2D boxes are in the project now, also those that show none of the classes.
        image_boxes: on their camera images, by class.
        objects: with boxes on all four views, by class.
        views: that carry their boxes now; objects with one box on the image share their first views.
        view_boxes: boxes on them in all; a view has those of all objects that it shows.
        without_views: objects on the image with too few points for views, by class.
        outside, hidden: objects that the image does not show: beyond its edges, or behind something; by class.
        other_classes: left out because the project has no such class, by class.
        not_reviewed: boxes on `frames` left out because nobody has accepted them in the dataset.
        drawn: frames that were left alone because somebody has drawn on their images, or finalised them.
        others_views: views of the other frames that keep the boxes somebody else has given them, drawn or imported.
        in_all: frames of the project with such boxes on their images now, those of earlier times too.
        unreadable: frames that could not be read, or whose own label file could not, as `key: reason`.
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

    def add(self, known: KnownFrame, kept: _Kept) -> None:
        """Counts a frame whose boxes are kept."""
        self.frames += 1
        self.image_boxes.update(box.label for box in known.on_image)
        self.objects.update(item.image_box.label for item in known.objects)
        self.views += len(kept.views)
        self.view_boxes += sum(len(view.boxes) for view in kept.views)
        self.others_views += kept.others
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
    """Turns known 3D boxes into 2D boxes of the project, frame by frame; its own of an earlier time are replaced.

    A frame is stored whole or not at all. Frames that somebody has drawn on or finalised are left alone; so are views
    whose boxes are somebody else's, and the boxes of frames that an earlier time had chosen and this one does not.

    Args:
        labels: the labelled frames and their objects.
        fraction: share of these frames, as `share_of` takes it.
        seed: of that choice.
        progress: called with (frames done, frames chosen).

    Raises:
        ConfigError: a fraction out of its range, or there is no box of the project's classes in any frame.
        FormatError: labels that cannot be read, where they are not one file a frame.
        RecordingError: a recording is not where it was.
    """
    source, config = FrameSource(project), rcv_config(project)
    recordings = {recording.id: recording.name for recording in project.recordings.all()}
    names = [(recordings[stored.recording_id], stored.key) for stored in labels.frames]
    share = share_of(names, fraction, seed)
    chosen = [stored for stored, name in zip(labels.frames, names, strict=True) if name in share]
    excused = (FrameError, FormatError) if labels.one_file_a_frame else (FrameError,)
    done = BoxesFrom3d(chosen=len(chosen))
    for number, stored in enumerate(chosen, 1):
        try:
            _take_over(project, stored, source, labels, config, done)
        except excused as error:
            done.unreadable.append(f"{stored.key}: {error}")
        if progress is not None:
            progress(number, len(chosen))
    _require_boxes(project, done)
    done.in_all = sum(boxes.author == AUTHOR for boxes in project.boxes.on_images())
    return done


def _take_over(
    project: Project,
    stored: StoredFrame,
    source: FrameSource,
    labels: KnownLabels,
    config: RcvConfig,
    done: BoxesFrom3d,
) -> None:
    if _is_drawn(read_page(project, stored.id)):  # asked first: what follows takes time
        done.drawn += 1
        return
    frame = source.read(stored)
    truths = labels.truths(stored, frame)
    settings = project.config
    done.other_classes.update(t.label for t in truths if t.label not in settings.classes)
    own = [truth for truth in truths if truth.label in settings.classes]
    orientation = orientation_for(settings.settings.rotation, frame)
    known = boxes_of_known(frame, own, config.model_copy(update={"orientation": orientation}))
    kept = _keep(project, stored.id, known)
    if kept is None:
        done.drawn += 1
    else:
        done.add(known, kept)
        done.not_reviewed += labels.not_reviewed(stored)


def _is_drawn(page: FramePage) -> bool:
    return page.frame.finalised or (page.image_boxes is not None and page.image_boxes.author != AUTHOR)


def _keep(project: Project, frame_id: int, known: KnownFrame) -> _Kept | None:
    """Stores a frame's boxes; None where somebody has drawn on it meanwhile."""
    on_image = ImageBoxesSet(boxes=known.on_image, box_kind=BoxKind.BOX)
    # two objects with one box on the image share their first views, which then carry the same boxes
    wanted = {entry.view: entry for entry in _view_boxes(project, known)}
    while True:
        page = read_page(project, frame_id)
        if _is_drawn(page):
            return None
        others = {view.view_id for view in page.view_boxes if view.author != AUTHOR} & wanted.keys()
        own = {view_id: entry for view_id, entry in wanted.items() if view_id not in others}
        payloads, kept = _changes(page, on_image, own), _Kept(tuple(own.values()), len(others))
        if not payloads:
            return kept
        # the frame was changed between the two lines, perhaps by an automatic pass
        with suppress(StaleRevisionError):
            project.log.append(frame_id, payloads, Change(page.frame.revision, AUTHOR, Source.IMPORTED))
            return kept


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


def _changes(page: FramePage, on_image: ImageBoxesSet, wanted: Mapping[str, ViewBoxesSet]) -> list[Payload]:
    """What leads from the frame as it is to the wanted boxes; views of an earlier time go."""
    payloads: list[Payload] = []
    if page.image_boxes is None or page.image_boxes.boxes != on_image.boxes:
        payloads.append(on_image)
    there = {view.view_id: view for view in page.view_boxes}
    for view_id, entry in wanted.items():
        view = there.get(view_id)
        if view is None or (view.boxes, view.step, view.geometry) != (entry.boxes, entry.step, entry.geometry):
            payloads.append(entry)
    gone = [view.view_id for view in page.view_boxes if view.author == AUTHOR and view.view_id not in wanted]
    return payloads + [ViewBoxesRemoved(view=view_id) for view_id in gone]


def _require_boxes(project: Project, done: BoxesFrom3d) -> None:
    if done.image_boxes or done.drawn:
        return
    others = ", ".join(sorted(done.other_classes)) or "none"
    unreadable = "".join(f"\n  unreadable: {line}" for line in done.unreadable)
    raise ConfigError(
        f"no box of {', '.join(project.config.classes)} is on any of {done.chosen} frames (other classes there: "
        f"{others}); choose other frames, or create the project with these classes{unreadable}"
    )
