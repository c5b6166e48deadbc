"""Training samples of reviewed objects that are put into other frames (`rcv.pasting`).

Both the frames that the objects come from and those that they are put into are frames that train; held-out frames are
never used.
"""

from __future__ import annotations

from collections.abc import Container, Iterator
from dataclasses import dataclass

import numpy as np

from annotator.detection.dataset import TrainingSample
from annotator.geometry.outline import box_on_image, points_on_image
from annotator.geometry.sight_grid import SightGrid
from annotator.project import Project
from annotator.rcv.config import RcvConfig
from annotator.rcv.pasting.image import ImagePatch, draw_patch, image_patch
from annotator.rcv.pasting.objects import Cutout, PastedFrame, Target, can_paste, cut_objects, paste
from annotator.rcv.teach import TaughtView, teach_agnostic_views, teach_views
from annotator.types import Box2D, BoxKind, Label, OrientedBox
from annotator.workflows.training.samples import (
    KnownObjects,
    Material,
    SampleConfig,
    Skip,
    frame_group,
    image_sample,
    known_objects,
)

PASTED = "pasted"
# Crops of each pasted object; each gives two views.
DRAWS = 3
# Frames that take part, drawn by chance, so that reading them does not take long.
MOST_FRAMES = 100
# How many objects are tried in a frame, and places for each: an object is given up late, so that those that fit nearly
# everywhere are not pasted much more often.
OBJECTS, PLACES = 3, 6


@dataclass(frozen=True, eq=False)
class _Source:
    """An object, its pixels if they are drawn, its label and its frame."""

    cutout: Cutout
    patch: ImagePatch | None
    label: Label
    frame_id: int


@dataclass(frozen=True, eq=False)
class Pasted:
    """A frame with a pasted object, which is the last one of its objects.

    Attributes:
        known: the frame before.
        patch: pixels of the pasted object, if asked for.
        label: of the pasted object where it was cut out.
    """

    known: KnownObjects
    frame: PastedFrame
    patch: ImagePatch | None
    label: Label


def pasted_view_samples(
    project: Project,
    material: Material,
    rcv: RcvConfig,
    config: SampleConfig,
    most_draws: int,
    held_out: Container[str],
    agnostic: bool,
    skip: Skip,
) -> Iterator[TrainingSample]:
    """Yields views of pasted objects: `config.pasted` of all views that `config` asks for, or fewer if places are rare.

    Args:
        most_draws: as for `known_objects`.
        held_out: groups of frames that are not used.
        agnostic: views for a class-agnostic detector; otherwise all objects on a view are labelled.
    """
    total = sum(map(len, material.taught(agnostic).values()))
    views = min(max(config.views, 2 * total), 2 * total * most_draws) * config.pasted
    count = round(views / (2 * DRAWS))
    for pasted in pasted_frames(project, material, rcv, config, count, held_out, skip, both_kinds=agnostic):
        for taught in _views(pasted, material, agnostic):
            uids = (pasted.label.uid,) * len(taught.boxes) if agnostic else ()
            view = taught.view
            yield TrainingSample(view.rgb, taught.boxes, frame_group(pasted.known.stored), PASTED, uids, view.look_px)


def pasted_image_samples(
    project: Project, material: Material, rcv: RcvConfig, config: SampleConfig, held_out: Container[str], skip: Skip
) -> Iterator[TrainingSample]:
    """Yields camera images with pasted objects: up to `config.pasted_images` of all camera images that train.

    Only images on which all objects are known are used.

    Args:
        held_out: groups of frames that are not used.
    """
    if config.pasted_images == 0:
        return
    known = material.labels.keys() - material.open.keys()
    some = _only(material, sorted(known))
    train = [s for s in project.frames.of() if s.id in known | material.images.keys()]
    real = sum(frame_group(stored) not in held_out for stored in train)
    count = round(real * config.pasted_images / (1 - config.pasted_images))
    for pasted in pasted_frames(project, some, rcv, config, count, held_out, skip, with_images=True):
        rgb = None if pasted.patch is None else draw_patch(pasted.patch, pasted.frame)
        box = _image_box(pasted, material.image_kind)
        if rgb is not None and box is not None:
            before = image_sample(material, pasted.known.stored, pasted.known.frame)
            uids = (*before.label_uids, pasted.label.uid)
            yield TrainingSample(rgb, (*before.boxes, box), before.group, PASTED, uids)


def _image_box(pasted: Pasted, kind: BoxKind) -> Box2D | None:
    camera, item = pasted.frame.frame.camera, pasted.frame.objects[-1]
    if kind is BoxKind.BOX:
        return box_on_image(camera, item.box, item.label)
    return points_on_image(camera, pasted.frame.frame.cloud.xyz_m[item.points], item.label)


def pasted_frames(
    project: Project,
    material: Material,
    rcv: RcvConfig,
    config: SampleConfig,
    count: int,
    held_out: Container[str],
    skip: Skip,
    with_images: bool = False,
    both_kinds: bool = False,
) -> Iterator[Pasted]:
    """Yields up to `count` frames with one pasted object each, spread evenly over the frames that train.

    Args:
        with_images: keep the pixels of the objects, too.
        both_kinds: as for `known_objects`.
    """
    rng = np.random.default_rng([config.seed, 1])
    train = [s.id for s in project.frames.of() if s.id in material.labels and frame_group(s) not in held_out]
    if count == 0 or len(train) < 2:
        return
    chosen = rng.permutation(train)[:MOST_FRAMES].tolist()
    some = _only(material, chosen)
    sources = [
        _Source(cutout, image_patch(known.frame, cutout) if with_images else None, label, known.stored.id)
        for known in known_objects(project, some, rcv, config, 1, skip, both_kinds)
        for label, cutout in _cut(known)
    ]
    done = 0
    for number, known in enumerate(known_objects(project, some, rcv, config, 1, skip, both_kinds), start=1):
        target = _target(known, material)
        fitting = [s for s in sources if s.frame_id != known.stored.id and can_paste(s.cutout, target)]
        until = round(count * number / len(chosen))
        while fitting and done < until:
            done += 1
            pasted = _tried(fitting, target, rng)
            if pasted is not None:
                frame, source = pasted
                yield Pasted(known, frame, source.patch, source.label)
        done = until


def _only(material: Material, frame_ids: list[int]) -> Material:
    """What is known of some frames with reviewed 3D labels."""
    labels = {frame_id: material.labels[frame_id] for frame_id in frame_ids}
    views = tuple(view for view in material.views if view.frame_id in labels)
    return Material({}, views, labels, material.kind, material.open)


def _cut(known: KnownObjects) -> Iterator[tuple[Label, Cutout]]:
    objects = known.objects[: len(known.labels)]
    for label, cutout in zip(known.labels, cut_objects(known.frame, objects, known.up), strict=True):
        if cutout is not None:
            yield label, cutout


def _target(known: KnownObjects, material: Material) -> Target:
    doubtful = tuple(_doubtful(known, material))
    return Target(known.frame, tuple(known.objects), doubtful, known.up, SightGrid.of(known.frame))


def _doubtful(known: KnownObjects, material: Material) -> list[OrientedBox]:
    """The boxes of objects that are not taught, and of those that nobody has reviewed."""
    return [label.box for label in (*material.open.get(known.stored.id, ()), *known.untaught)]


def _tried(sources: list[_Source], target: Target, rng: np.random.Generator) -> tuple[PastedFrame, _Source] | None:
    for number in rng.permutation(len(sources))[:OBJECTS].tolist():
        for _ in range(PLACES):
            frame = paste(sources[number].cutout, target, rng)
            if frame is not None:
                return frame, sources[number]
    return None


def _views(pasted: Pasted, material: Material, agnostic: bool) -> list[TaughtView]:
    known, shown = pasted.known, pasted.frame
    last = [len(shown.objects) - 1]
    if agnostic:
        return teach_agnostic_views(shown.frame, shown.objects, last, DRAWS, known.rcv, known.up, known.rng)
    doubtful = _doubtful(known, material)
    return teach_views(shown.frame, shown.objects, material.kind, DRAWS, known.rcv, known.up, known.rng, doubtful, last)
