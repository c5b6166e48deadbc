"""Training samples for a project's detectors.

The image detector learns from the boxes on camera images, and from 3D labels projected onto them. The pseudo-view
detector learns from the boxes drawn on pseudo-views, and from generated views along random axes of every object whose
3D extent is known: from an accepted, edited or imported 3D box, or from the points inside all boxes that an operator
drew around it.

For a class-agnostic view detector, which continues the base detector, only the object that a crop is about is labelled,
so objects that nobody has reviewed do no harm. Each view has up to two boxes, around the whole object and around what
is seen of it. Where the project knows only one of them, the detector that the training starts from gives the other one,
so that it is not forgotten.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import UInt8
from pydantic import Field

from annotator.detection.dataset import TrainingSample
from annotator.geometry.oriented_box import aligned_box, contains
from annotator.project import REVIEWED, ImageBoxes, Project, StoredFrame, StoredLabel, ViewBoxes
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig
from annotator.rcv.known_objects import LABELLED_STEPS, cut_out
from annotator.rcv.recursion import held_direction
from annotator.rcv.teach import MIN_POINTS, TaughtObject, TaughtView, project_box, teach_views
from annotator.types import Box2D, BoxKind, Detector, DetectorKind, Frame, Image, Label, OrientedBox, ReviewState
from annotator.types.bases import Strict
from annotator.types.detector import Picture
from annotator.types.errors import DetectionError, FrameError
from annotator.workflows.frame_source import FrameSource, orientation_for
from annotator.workflows.training.base_detector import generated_views
from annotator.workflows.views import front_and_side, outlines, redrawn, spans_m, undrawn, views_by_object

DRAWN, TAUGHT, PROJECTED = "drawn", "taught", "projected"

Skip = Callable[[StoredFrame, FrameError], None]
"""Called with a labelled frame that cannot be read and is left out."""


class SampleConfig(Strict):
    views: int = Field(480, ge=1, description="approximate number of generated pseudo-views in all")
    seed: int = Field(0, ge=0, description="seed of the random axes and crops")


@dataclass(frozen=True, eq=False)
class Material:
    """The labels of a project that its detectors learn from.

    Attributes:
        images: labelled camera images, by frame.
        views: labelled pseudo-views, of both kinds.
        labels: reviewed 3D labels, by frame.
        kind: what the view detector's boxes will measure.
        open: unreviewed proposals, by frame, which may or may not be objects.
        whole: the whole boxes of drawn objects, by frame and box on its image.
        others: reviewed labels of other cameras of the moment, by frame; objects on its image, too.
    """

    images: dict[int, ImageBoxes]
    views: tuple[ViewBoxes, ...]
    labels: dict[int, tuple[Label, ...]]
    kind: BoxKind
    open: dict[int, tuple[Label, ...]] = field(default_factory=dict)
    whole: dict[tuple[int, Box2D], OrientedBox] = field(default_factory=dict)
    others: dict[int, tuple[Label, ...]] = field(default_factory=dict)

    @property
    def views_of_kind(self) -> tuple[ViewBoxes, ...]:
        """The labelled views that a detector with the project's classes learns from."""
        return tuple(view for view in self.views if view.box_kind is self.kind or not view.boxes)

    def labels_of(self, *kinds: BoxKind) -> dict[int, tuple[Label, ...]]:
        """The reviewed labels whose boxes enclose this, by frame."""
        of_kinds = {
            frame: tuple(label for label in labels if label.box_kind in kinds) for frame, labels in self.labels.items()
        }
        return {frame: labels for frame, labels in of_kinds.items() if labels}

    @property
    def unreviewed_images(self) -> int:
        """Camera images left out because they have unreviewed proposals and no drawn box."""
        return sum(frame in self.open for frame in self.labels.keys() - self.images.keys())

    @property
    def image_kind(self) -> BoxKind:
        kinds = Counter(boxes.box_kind for boxes in self.images.values())
        return kinds.most_common(1)[0][0] if kinds else BoxKind.BOX


def gather(project: Project, roles: Sequence[DetectorKind] = tuple(DetectorKind)) -> Material:
    """Returns the labels that the project's detectors can learn from now."""
    images = {boxes.frame_id: boxes for boxes in project.boxes.on_images()}
    views = project.boxes.on_views()
    stored = project.labels.select(states=REVIEWED)
    reviewed = _by_frame(stored)
    drawn = {DetectorKind.IMAGE: (images, "camera images"), DetectorKind.VIEW: (views, "pseudo-views")}
    missing = [name for role, (boxes, name) in drawn.items() if role in roles and not boxes]
    if missing and not reviewed:
        raise DetectionError(
            f"project {project.config.name} has no boxes on {' or '.join(missing)} to learn from; draw some, import "
            "them with `annotator import`, let `annotator simulate` draw them from a recording's truth, or add a "
            "recording with 3D labels"
        )
    unreviewed = _by_frame(project.labels.select(states=[ReviewState.PROPOSED]))
    whole = {
        (one.frame_id, one.image_box): one.label.box
        for one in stored
        if one.image_box is not None and one.label.box_kind is BoxKind.BOX
    }
    others = _of_other_cameras(project, {*images, *reviewed}) if DetectorKind.IMAGE in roles else {}
    material = Material(images, views, reviewed, _kind(views, stored, whole), unreviewed, whole, others)
    if DetectorKind.IMAGE in roles and not images and material.unreviewed_images == len(reviewed):
        raise DetectionError(
            f"project {project.config.name} has no camera image to learn from: every frame with reviewed boxes also "
            "has unreviewed proposals, which the detector would learn as background; review all proposals of a frame"
        )
    return material


def _kind(
    views: Sequence[ViewBoxes], labels: Sequence[StoredLabel], whole: Container[tuple[int | None, Box2D]]
) -> BoxKind:
    """What most boxes enclose; the silhouettes of an object whose whole box is known do not count."""
    kinds = Counter(stored.label.box_kind for stored in labels for _ in range(4))
    for view in views:
        image_box = None if view.geometry is None else view.geometry.image_box
        if image_box is None or (view.frame_id, image_box) not in whole:
            kinds[view.box_kind] += len(view.boxes)
    return BoxKind.BOX if kinds[BoxKind.BOX] >= kinds[BoxKind.SILHOUETTE] else BoxKind.SILHOUETTE


def _of_other_cameras(project: Project, frame_ids: Set[int]) -> dict[int, tuple[Label, ...]]:
    """Returns the reviewed labels of each frame's moment that were made in the frames of other cameras."""
    every = project.frames.of()
    cameras = Counter(frame.moment_id for frame in every)
    return {
        frame.id: tuple(
            stored.label
            for stored in project.labels.of_moment(frame.id)
            if not stored.is_own and stored.label.state in REVIEWED
        )
        for frame in every
        if frame.id in frame_ids and cameras[frame.moment_id] > 1
    }


def _by_frame(stored_labels: Iterable[StoredLabel]) -> dict[int, tuple[Label, ...]]:
    frames: dict[int, list[Label]] = defaultdict(list)
    for stored in stored_labels:
        frames[stored.frame_id].append(stored.label)
    return {frame: tuple(labels) for frame, labels in frames.items()}


def image_samples(project: Project, material: Material, skip: Skip) -> Iterator[TrainingSample]:
    """Yields camera images with their drawn boxes and the outlines of 3D labels without a drawn box.

    Frames with unreviewed proposals and no drawn box are left out, since the objects would count as background.
    """
    known = material.labels.keys() - material.open.keys()
    for stored, frame in labelled_frames(project, sorted({*material.images, *known}), skip):
        drawn = material.images.get(stored.id)
        labels = (*material.labels.get(stored.id, ()), *material.others.get(stored.id, ()))
        if drawn is None:
            shown = outlines(frame.camera, labels)
            yield TrainingSample(frame.rgb, tuple(shown.values()), frame_group(stored), PROJECTED, tuple(shown))
        else:
            more = undrawn(frame.camera, labels, drawn.boxes)
            boxes, uids = (*drawn.boxes, *more.values()), (*_drawn_uids(drawn), *more)
            yield TrainingSample(frame.rgb, boxes, frame_group(stored), DRAWN, uids)


def view_samples(
    project: Project, material: Material, rcv: RcvConfig, config: SampleConfig, skip: Skip
) -> Iterator[TrainingSample]:
    """Yields drawn pseudo-views, then views along random axes of every object whose 3D extent is known."""
    for view, sample in _drawn(project, material.views_of_kind, skip):
        yield replace(sample, boxes=view.boxes, label_uids=_drawn_uids(view))
    for stored, labels, taught in taught_views(project, material, rcv, config, skip):
        uids = tuple(labels[index].uid for index in taught.objects if index < len(labels))
        drawn = taught.view
        yield TrainingSample(drawn.rgb, taught.boxes, frame_group(stored), TAUGHT, uids, drawn.look_px)


def _drawn(project: Project, views: Sequence[ViewBoxes], skip: Skip) -> Iterator[tuple[ViewBoxes, TrainingSample]]:
    """Yields drawn pseudo-views, each with a sample of its picture that has no boxes yet."""
    groups = {stored.id: frame_group(stored) for stored in project.frames.of()}
    for view, rgb in drawn_pictures(project, views, skip):
        group = f"view/{view.view_id[:12]}" if view.frame_id is None else groups[view.frame_id]
        look_px = 0 if view.geometry is None else view.geometry.look_px
        yield view, TrainingSample(rgb, (), group, DRAWN, (), look_px)


def drawn_pictures(
    project: Project, views: Sequence[ViewBoxes], skip: Skip
) -> Iterator[tuple[ViewBoxes, UInt8[np.ndarray, "_ _ 3"]]]:
    """Yields labelled pseudo-views with their pictures, which are new where a calibration was corrected.

    Views that the correction leaves without points in their boxes are passed to `skip`.
    """
    corrected = project.adjustments.corrected()
    moved = {stored.id for stored in project.frames.of(sorted(corrected))} if corrected else set()
    again: dict[int, list[ViewBoxes]] = defaultdict(list)
    for view in views:
        if view.frame_id in moved and view.geometry is not None and view.geometry.image_box is not None:
            again[view.frame_id].append(view)
        else:
            yield view, project.views.load(view.view_id)
    for stored, frame in labelled_frames(project, sorted(again), skip):
        objects = views_by_object(again[stored.id])
        for view in again[stored.id]:
            assert view.geometry is not None and view.geometry.image_box is not None
            steps = objects.get((stored.id, view.geometry.image_box), {})
            rgb = redrawn(frame, view, steps, lambda each: project.views.size(each.view_id))
            if rgb is not None:
                yield view, rgb
            else:
                path = project.views.path(view.view_id)
                skip(stored, FrameError(path, "the corrected calibration leaves no points in its box", "draw it again"))


def taught_views(
    project: Project,
    material: Material,
    rcv: RcvConfig,
    config: SampleConfig,
    skip: Skip,
    class_agnostic: bool = False,
) -> Iterator[tuple[StoredFrame, tuple[Label, ...], TaughtView]]:
    """Yields views of the objects whose 3D extent is known, with their frame and the labels that are its first objects.

    Args:
        class_agnostic: for such detectors, which learn the whole and what is seen: the labels are those whose whole box
            is known. (Whole boxes also give silhouettes: those of the points in them. Boxes around what is seen give no
            whole ones.)
    """
    kind = None if class_agnostic else material.kind
    taught = material.labels_of(BoxKind.BOX, kind or BoxKind.BOX)
    drags = {} if kind is BoxKind.BOX else drawn_objects(material.views)
    total = sum(map(len, taught.values())) + sum(map(len, drags.values()))
    if total == 0:
        return
    draws = int(np.clip(round(config.views / (2 * total)), 1, MOST_AGNOSTIC_DRAWS if class_agnostic else MOST_DRAWS))
    for stored, frame in labelled_frames(project, sorted({*material.labels, *drags}), skip):
        labels = taught.get(stored.id, ())
        doubtful: list[OrientedBox] = []
        if not class_agnostic:  # unreviewed ones, and those of the other kind
            others = (*material.open.get(stored.id, ()), *material.labels.get(stored.id, ()))
            doubtful = [label.box for label in others if label not in labels]
        cuts = [cut for views in drags.get(stored.id, ()) if (cut := taught_by_drags(frame, views)) is not None]
        # with the points that their drawn silhouettes enclose, if there are any
        drawn = [next((cut.points for cut in cuts if is_labelled(frame, cut, [label])), None) for label in labels]
        objects = [TaughtObject(label.label, label.box, points) for label, points in zip(labels, drawn, strict=True)]
        objects += [cut for cut in cuts if not is_labelled(frame, cut, labels)]
        rng = np.random.default_rng([config.seed, stored.id])
        orientation = orientation_for(project.config.settings.rotation, frame)
        settings = rcv.model_copy(update={"orientation": orientation})
        up = held_direction(frame.up, settings)
        for view in teach_views(frame, objects, kind, draws, settings, up, rng, doubtful):
            yield stored, labels, view


def drawn_objects(views: Iterable[ViewBoxes]) -> dict[int, list[tuple[ViewBoxes, ...]]]:
    """Returns the views of each object whose silhouettes are fully drawn, by frame.

    The drawn boxes cut the object's points out of the cloud, which give its silhouette from any direction. Boxes
    around the whole object include unseen parts, so other directions require its 3D box.
    """
    finished: dict[int, list[tuple[ViewBoxes, ...]]] = defaultdict(list)
    silhouettes = [view for view in views if view.box_kind is BoxKind.SILHOUETTE]
    for (frame_id, _), steps in views_by_object(silhouettes).items():
        pairs = [front_and_side(steps[step]) for step in range(LABELLED_STEPS)]
        both = tuple(view for pair in pairs if pair is not None for view in pair)
        if None not in pairs and all(len(view.boxes) == 1 for view in both):
            finished[frame_id].append(both)
    return finished


def taught_by_drags(frame: Frame, views: Sequence[ViewBoxes]) -> TaughtObject | None:
    """Returns the object that the boxes drawn on its views cut out; None if it has too few points.

    Args:
        views: with one box each, and known geometry.
    """
    placed = [(view, view.geometry) for view in views if view.geometry is not None]
    image_box = placed[0][1].image_box
    assert image_box is not None  # views_by_object leaves out views without one
    spans = [((np.array(g.axes), spans_m(view)), g.metres_per_px / 2) for view, g in placed]
    mask = cut_out(frame, image_box, spans)
    if mask.sum() < MIN_POINTS:
        return None
    last = max(placed, key=lambda pair: pair[0].step or 0)[1]
    return TaughtObject(views[0].boxes[0].label, aligned_box(frame.cloud.xyz_m[mask], np.array(last.axes).T), mask)


def is_labelled(frame: Frame, cut: TaughtObject, labels: Sequence[Label]) -> bool:
    """Returns True if the object also has a reviewed 3D box, which would give it two boxes on each view."""
    xyz_m = frame.cloud.xyz_m[cut.points]
    return any(label.label == cut.label and contains(label.box, xyz_m).mean() >= 0.5 for label in labels)


def _drawn_uids(drawn: ImageBoxes | ViewBoxes) -> tuple[str, ...]:
    """Returns ids of drawn boxes, made from the event that set them and their index, since they have no uid."""
    return tuple(f"event {drawn.event_id}, box {index}" for index in range(len(drawn.boxes)))


def frame_group(stored: StoredFrame) -> str:
    return f"{stored.recording_id}/{stored.key}"


def labelled_frames(project: Project, frame_ids: Sequence[int], skip: Skip) -> Iterator[tuple[StoredFrame, Frame]]:
    """Yields frames, one in memory at a time; passes those that cannot be read to `skip`."""
    source = FrameSource(project)
    for frame_id in frame_ids:
        stored = project.frames.get(frame_id)
        try:
            frame = source.read(stored)
        except FrameError as error:
            skip(stored, error)
            continue
        yield stored, frame


# Share of generated views among the training views of a class-agnostic detector (docs/notebook.md).
GENERATED_SHARE = 0.2
# Generated frames from here on were not seen in the training of the base detector.
FIRST_SEED = 10_000_000
# Crops per object of a generated frame, and about how many views they give per frame.
GENERATED_DRAWS, GENERATED_VIEWS = 2, 13
# Maximum number of crops per object of the project, each with two views: for its classes, and for class-agnostic
# detectors, which learn from fewer objects.
MOST_DRAWS, MOST_AGNOSTIC_DRAWS = 20, 60
# Minimum score of a detection that stands in for an unknown box.
MIN_SCORE = 0.3


def agnostic_samples(
    project: Project, material: Material, rcv: RcvConfig, config: SampleConfig, start: Detector, skip: Skip
) -> Iterator[TrainingSample]:
    """Yields drawn pseudo-views, then views along random axes of every object whose 3D extent is known.

    Args:
        start: the class-agnostic detector that the training starts from.
    """
    # the drawn box of a view's own object, which is the first of a view that belongs to an object
    for view, sample in _drawn(project, material.views, skip):
        if len(view.boxes) <= 1 or (view.geometry is not None and view.geometry.image_box is not None):
            yield replace(sample, boxes=_boxes_of(view, material, start, sample.rgb))
    for stored, labels, taught in taught_views(project, material, rcv, config, skip, class_agnostic=True):
        index = taught.objects[0] if taught.objects else None
        boxes, uids = taught.boxes, tuple[str, ...]()
        if index is not None and index < len(labels):
            uids = (labels[index].uid,) * len(boxes)
        elif index is not None:  # the extent of a drawn silhouette says nothing about the whole
            seen = [box for box in boxes if box.label == AGNOSTIC_LABELS[BoxKind.SILHOUETTE]]
            boxes = _completed(start, Picture(taught.view.rgb), seen)
        yield TrainingSample(taught.view.rgb, boxes, frame_group(stored), TAUGHT, uids, taught.view.look_px)


def with_generated(own: Iterable[TrainingSample], size_px: int, seed: int) -> Iterator[TrainingSample]:
    """Yields a project's views, then views of generated frames, so that what the base detector knows is kept."""
    count = 0
    for sample in own:
        yield sample
        count += 1
    views = count * GENERATED_SHARE / (1 - GENERATED_SHARE)
    first = FIRST_SEED + seed * 100_000
    for number in range(first, first + round(views / GENERATED_VIEWS)):
        yield from generated_views(number, GENERATED_DRAWS, size_px)


def _boxes_of(view: ViewBoxes, material: Material, start: Detector, rgb: np.ndarray) -> tuple[Box2D, ...]:
    known = [replace(box, label=AGNOSTIC_LABELS[view.box_kind]) for box in view.boxes[:1]]
    geometry = view.geometry
    if known and view.box_kind is BoxKind.SILHOUETTE and geometry is not None and geometry.image_box is not None:
        whole = material.whole.get((view.frame_id or 0, geometry.image_box))
        shown = None if whole is None else project_box(geometry.view(rgb), whole, AGNOSTIC_LABELS[BoxKind.BOX])
        known += [] if shown is None else [shown]
    return _completed(start, Picture(rgb), known)


def _completed(start: Detector, picture: Image, known: Sequence[Box2D]) -> tuple[Box2D, ...]:
    """Adds the detector's best box of each class without a known box; an object that is not there gets none."""
    if not known:
        return ()
    present = {box.label for box in known}
    best: dict[str, Box2D] = {}
    for box in start.detect([picture])[0]:
        if box.label not in present and box.score >= MIN_SCORE:
            best.setdefault(box.label, box)
    return (*known, *best.values())
