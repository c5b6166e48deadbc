"""2D training boxes from known 3D boxes (RCV paper, Fig. 5): on camera images and on the first two steps' views.

Only the 2D boxes are kept, as imported ones that measure the whole object (`BoxKind.BOX`); the frames stay without 3D
labels. So the detectors learn what the paper's did, from 2D boxes alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from annotator.project import Change, Project, StoredFrame
from annotator.project.overview import FramePage, read_page
from annotator.project.payloads import ImageBoxesSet, Payload, ViewBoxesRemoved, ViewBoxesSet
from annotator.rcv.config import RcvConfig
from annotator.rcv.known_objects import KnownFrame, boxes_of_known
from annotator.types import BoxKind, Frame, Source, Truth
from annotator.types.errors import ConfigError, FrameError, StaleRevisionError
from annotator.workflows.frame_share import share_of
from annotator.workflows.frames import FrameSource, orientation_for
from annotator.workflows.rcv_settings import rcv_config
from annotator.workflows.truth import has_truth, load_truth
from annotator.workflows.views_out import geometry_of

# Boxes of this author are replaced by a later import, those of all others are left alone.
AUTHOR = "import of 3D boxes"

Labels = Callable[[StoredFrame, Frame], Sequence[Truth] | None]
"""The known objects of a frame, boxes in the camera frame; None for a frame that nobody has labelled."""


@dataclass
class BoxesFrom3d:
    """What was made of the 3D boxes.

    Attributes:
        chosen: frames that were looked at.
        frames: whose 2D boxes are in the project now, also those that show none of the classes.
        image_boxes: on their camera images, by class.
        objects: with boxes on all four views, by class.
        view_boxes: boxes on views in all; a view has those of all objects that it shows.
        without_views: objects on the image with too few points for views, by class.
        outside, hidden: objects that the image does not show: beyond its edges, or behind something; by class.
        other_classes: left out because the project has no such class, by class.
        unlabelled: frames for which there are no labels.
        drawn: frames that were left alone because somebody has labelled their images already.
        unreadable: frames that could not be read, as `key: reason`.
    """

    chosen: int = 0
    frames: int = 0
    image_boxes: Counter[str] = field(default_factory=Counter)
    objects: Counter[str] = field(default_factory=Counter)
    view_boxes: int = 0
    without_views: Counter[str] = field(default_factory=Counter)
    outside: Counter[str] = field(default_factory=Counter)
    hidden: Counter[str] = field(default_factory=Counter)
    other_classes: Counter[str] = field(default_factory=Counter)
    unlabelled: int = 0
    drawn: int = 0
    unreadable: list[str] = field(default_factory=list)

    def add(self, known: KnownFrame) -> None:
        """Counts a frame whose boxes are kept."""
        self.frames += 1
        self.image_boxes.update(box.label for box in known.on_image)
        self.objects.update(item.image_box.label for item in known.objects)
        self.view_boxes += sum(len(view.boxes) for item in known.objects for view in item.views)
        for counter, labels in (
            (self.without_views, known.without_views),
            (self.outside, known.outside),
            (self.hidden, known.hidden),
        ):
            counter.update(labels)


def labels_beside(project: Project, recordings: Collection[int] | None = None) -> Labels:
    """The labels that lie beside the project's recordings, such as KITTI's `label_2`.

    Args:
        recordings: ids of those that are asked for; None = all.

    Raises:
        ConfigError: none of them brings labels.
        RecordingError: one of them cannot be read.
    """
    source = FrameSource(project)
    asked = [r.id for r in project.recordings.all() if recordings is None or r.id in recordings]
    labelled = {i for i in asked if has_truth(source.recording(i))}
    if not labelled:
        names = ", ".join(project.recordings.get(i).name for i in asked) or "the project has no recording"
        raise ConfigError(f"no 3D boxes lie beside the recordings ({names}); name the file or folder that holds them")
    places = {i: {key: n for n, key in enumerate(source.recording(i).keys)} for i in labelled}

    def labels(stored: StoredFrame, frame: Frame) -> Sequence[Truth] | None:
        if stored.recording_id not in labelled:
            return None
        recording = source.recording(stored.recording_id)
        return load_truth(recording, places[stored.recording_id][stored.key], frame)

    return labels


def boxes_from_3d(
    project: Project,
    labels: Labels,
    *,
    fraction: float = 1.0,
    seed: int = 0,
    recordings: Collection[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BoxesFrom3d:
    """Turns known 3D boxes into 2D boxes of the project, frame by frame; its own of an earlier time are replaced.

    A frame is stored whole or not at all. Frames that somebody has drawn on are left alone; so are the boxes of
    frames that an earlier time had chosen and this one does not.

    Args:
        labels: gives the known objects of a frame.
        fraction: share of the frames, as `share_of` takes it.
        seed: of that choice.
        recordings: ids; None = all.
        progress: called with (frames done, frames chosen).

    Raises:
        ConfigError: a fraction out of its range, or there is no box of the project's classes in any frame.
        FormatError: labels that cannot be read.
        RecordingError: a recording is not where it was.
    """
    source, config = FrameSource(project), rcv_config(project)
    names = {recording.id: recording.name for recording in project.recordings.all()}
    chosen_ids = None if recordings is None else sorted(recordings)
    present = [stored for stored in project.frames.of(chosen_ids) if stored.index is not None]
    share = share_of(((names[stored.recording_id], stored.key) for stored in present), fraction, seed)
    chosen = [stored for stored in present if (names[stored.recording_id], stored.key) in share]
    done = BoxesFrom3d(chosen=len(chosen))
    for number, stored in enumerate(chosen, 1):
        try:
            _take_over(project, stored, source, labels, config, done)
        except FrameError as error:
            done.unreadable.append(f"{stored.key}: {error}")
        if progress is not None:
            progress(number, len(chosen))
    _require_boxes(project, done)
    return done


def _take_over(
    project: Project, stored: StoredFrame, source: FrameSource, labels: Labels, config: RcvConfig, done: BoxesFrom3d
) -> None:
    if _is_drawn(read_page(project, stored.id)):  # asked first: what follows takes time
        done.drawn += 1
        return
    frame = source.read(stored)
    truths = labels(stored, frame)
    if truths is None:
        done.unlabelled += 1
        return
    settings = project.config
    done.other_classes.update(t.label for t in truths if t.label not in settings.classes)
    own = [truth for truth in truths if truth.label in settings.classes]
    orientation = orientation_for(settings.settings.rotation, frame)
    known = boxes_of_known(frame, own, config.model_copy(update={"orientation": orientation}))
    if _keep(project, stored.id, known):
        done.add(known)
    else:
        done.drawn += 1


def _is_drawn(page: FramePage) -> bool:
    return page.image_boxes is not None and page.image_boxes.author != AUTHOR


def _keep(project: Project, frame_id: int, known: KnownFrame) -> bool:
    """Stores a frame's boxes; False where somebody has drawn on it meanwhile."""
    on_image = ImageBoxesSet(boxes=known.on_image, box_kind=BoxKind.BOX)
    # two objects with one box on the image share their first views, which then carry the same boxes
    wanted = {entry.view: entry for entry in _view_boxes(project, known)}
    while True:
        page = read_page(project, frame_id)
        if _is_drawn(page):
            return False
        payloads = _changes(page, on_image, wanted)
        if not payloads:
            return True
        # the frame was changed between the two lines, perhaps by an automatic pass
        with suppress(StaleRevisionError):
            project.log.append(frame_id, payloads, Change(page.frame.revision, AUTHOR, Source.IMPORTED))
            return True


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
