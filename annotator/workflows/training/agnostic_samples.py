"""Training samples for a project's class-agnostic view detector, which continues the base detector.

Only the object that a crop is about is labelled, so objects that nobody has reviewed do no harm. Each view has up to
two boxes, around the whole object and around what is seen of it. Where the project knows only one of them, the detector
that the training starts from gives the other one, so that it is not forgotten.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from annotator.detection.dataset import TrainingSample
from annotator.project import Project, ViewBoxes
from annotator.rcv.config import AGNOSTIC_LABELS, RcvConfig
from annotator.rcv.teach import project_box, teach_agnostic_views
from annotator.types import Box2D, BoxKind, Detector, Image
from annotator.workflows.training.base_detector import generated_views
from annotator.workflows.training.samples import (
    DRAWN,
    TAUGHT,
    Material,
    SampleConfig,
    Skip,
    drawn_pictures,
    frame_group,
    known_objects,
)

# Generated frames from here on were not seen in the training of the base detector.
FIRST_SEED = 10_000_000
# Crops per object of a generated frame, and about how many views they give per frame.
GENERATED_DRAWS, GENERATED_VIEWS = 2, 13
# Maximum number of crops per object of the project; each gives two views.
MOST_DRAWS = 60
# Minimum score of a detection that stands in for an unknown box.
MIN_SCORE = 0.3


@dataclass(frozen=True, eq=False)
class _Picture:
    rgb: np.ndarray


def agnostic_samples(
    project: Project, material: Material, rcv: RcvConfig, config: SampleConfig, start: Detector, skip: Skip
) -> Iterator[TrainingSample]:
    """Yields drawn pseudo-views, then views along random axes of every object whose 3D extent is known.

    Args:
        start: the class-agnostic detector that the training starts from.
    """
    yield from _drawn(project, material, rcv, start, skip)
    for known in known_objects(project, material, rcv, config, MOST_DRAWS, skip, both_kinds=True):
        labels, objects = known.labels, known.objects
        for taught in teach_agnostic_views(
            known.frame, objects, range(len(objects)), known.draws, known.rcv, known.up, known.rng
        ):
            index = taught.objects[0] if taught.objects else None
            boxes, uids = taught.boxes, tuple[str, ...]()
            if index is not None and index < len(labels):
                uids = (labels[index].uid,) * len(boxes)
            elif index is not None:  # the extent of a drawn silhouette says nothing about the whole
                seen = [box for box in boxes if box.label == AGNOSTIC_LABELS[BoxKind.SILHOUETTE]]
                boxes = _completed(start, _Picture(taught.view.rgb), seen)
            yield TrainingSample(taught.view.rgb, boxes, frame_group(known.stored), TAUGHT, uids, taught.view.look_px)


def with_generated(own: Iterable[TrainingSample], share: float, size_px: int, seed: int) -> Iterator[TrainingSample]:
    """Yields a project's views, then views of generated frames, so that what the base detector knows is kept.

    Args:
        share: of generated views among all, below 1; about that many are drawn.
        size_px: longer side of the generated views.
        seed: other seeds give other frames.
    """
    count = 0
    for sample in own:
        yield sample
        count += 1
    views = count * share / (1 - share)
    first = FIRST_SEED + seed * 100_000
    for number in range(first, first + round(views / GENERATED_VIEWS)):
        yield from generated_views(number, GENERATED_DRAWS, size_px)


def _drawn(
    project: Project, material: Material, rcv: RcvConfig, start: Detector, skip: Skip
) -> Iterator[TrainingSample]:
    """Views with the drawn box of their own object, which is the first of a view that belongs to an object."""
    groups = {stored.id: frame_group(stored) for stored in project.frames.of()}
    for view, rgb in drawn_pictures(project, material.views, rcv, skip):
        if len(view.boxes) > 1 and (view.geometry is None or view.geometry.image_box is None):
            continue  # nothing says which object the view is about
        group = f"view/{view.view_id[:12]}" if view.frame_id is None else groups[view.frame_id]
        look_px = 0 if view.geometry is None else view.geometry.look_px
        yield TrainingSample(rgb, _boxes_of(view, material, start, rgb), group, DRAWN, (), look_px)


def _boxes_of(view: ViewBoxes, material: Material, start: Detector, rgb: np.ndarray) -> tuple[Box2D, ...]:
    known = [replace(box, label=AGNOSTIC_LABELS[view.box_kind]) for box in view.boxes[:1]]
    geometry = view.geometry
    if known and view.box_kind is BoxKind.SILHOUETTE and geometry is not None and geometry.image_box is not None:
        whole = material.whole.get((view.frame_id or 0, geometry.image_box))
        shown = None if whole is None else project_box(geometry.view(rgb), whole, AGNOSTIC_LABELS[BoxKind.BOX])
        known += [] if shown is None else [shown]
    return _completed(start, _Picture(rgb), known)


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
