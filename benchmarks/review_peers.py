"""What a box costs in other tools, walked through from what they publish about themselves.

Each tool gives a first box, and then offers actions in its views along the box's axes. The walk begins with the most
favourable first box: the camera needs no turn, the true heading and the class are found at once, and a fit to the
points finds all of the object's and no others. From there, `review_moves.plan` finds the shortest way with the tool's
actions, by the same hand, with the same looks. Frames are labelled one by one. Left out are the interpolation and
tracking that some of them have, and the ways between frames.

- SUSTechPOINTS (doc/operations.md of its repository): Ctrl and a drag around the object fit a box to its points. In
  three views along its axes, borders, corners and the box are dragged, and keys turn it.
- CVAT (its manual, "3D Object annotation"): after three clicks (tool, class, shape), a double-click places a cube near
  the points, here of 1 m. In three views it is moved, its corners are dragged, and a point turns it.
- labelCloud (README of its repository): after a click, four picked points span the length, width and height of what is
  seen. Sides are moved with the wheel above them, the box is moved and turned with keys.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from annotator.detection.pretrained import NAME
from annotator.geometry.iou import iou_3d
from annotator.geometry.oriented_box import aligned_box
from annotator.project import (
    BoxRotation,
    NewLabel,
    Project,
    ProjectSettings,
    WriteContext,
    create_project,
    open_project,
)
from annotator.recordings import open_recording
from annotator.types import DetectorKind, OrientedBox, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import (
    Detectors,
    active_model,
    base_model,
    base_titles,
    load_detector,
    own_model,
    view_model,
)
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import visible_objects
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.training.train import ProgressCallback, TrainPlan, image_defaults, train
from annotator.workflows.workbench.review_queue import Order, queue
from benchmarks.review_desk import AUTHOR
from benchmarks.review_moves import CLICK_S, DRAG_S, KEY_S, Bill, Hand, Move, P, moves, plan

# Side of CVAT's first cube, metres. Keys or notches of the wheel for one correction in labelCloud, at least.
CUBE_M, STEPS = 1.0, 5
MOST_ACTIONS = 20


@dataclass(frozen=True)
class Tool:
    """A tool: the first actions with their seconds, whether they fit the box to points, and the actions it offers, with
    the seconds of those that are no drags."""

    first: tuple[tuple[str, float], ...]
    fits: bool
    offers: frozenset[str]
    seconds: dict[str, float]


TOOLS = {
    "SUSTechPOINTS": Tool(
        (("draw", KEY_S + DRAG_S),),
        True,
        frozenset({"drag edge", "drag corner", "drag box", "turn"}),
        {"turn": STEPS * KEY_S},
    ),
    "CVAT": Tool(
        (("click", CLICK_S),) * 3 + (("place", CLICK_S + 2 * (CLICK_S - P) / 2),),
        False,
        frozenset({"drag corner", "drag box", "turn"}),
        {},
    ),
    "labelCloud": Tool(
        (("click", CLICK_S),) * 5,
        True,
        frozenset({"drag edge", "drag box", "turn"}),
        {"drag edge": P + STEPS * KEY_S, "drag box": 2 * STEPS * KEY_S, "turn": STEPS * KEY_S},
    ),
}

Seen = tuple[OrientedBox, np.ndarray]
"""A true box, and the points inside it, (n, 3)."""


def peers(seen: Sequence[Seen], quality: float, hand: Hand) -> dict[str, dict[str, Any]]:
    """Draws objects with each tool; returns the figures by tool."""
    result = {}
    for name, tool in TOOLS.items():
        offered = [
            Move(move.kind, tool.seconds.get(move.kind, move.seconds), move.apply)
            for move in moves()
            if move.kind in tool.offers
        ]
        bill, missed = Bill(), 0
        for truth, xyz_m in seen:
            missed += not _draw(tool, truth, xyz_m, offered, quality, hand, bill)
        result[name] = {
            "boxes": len(seen),
            "actions_per_box": bill.count / max(len(seen), 1),
            "seconds_per_box": bill.seconds / max(len(seen), 1),
            "by_kind": bill.by_kind,
            "failures": missed / max(len(seen), 1),
        }
    return result


def _draw(
    tool: Tool, truth: OrientedBox, xyz_m: np.ndarray, offered: Sequence[Move], quality: float, hand: Hand, bill: Bill
) -> bool:
    """Draws one object; returns whether its box is right."""
    bill.looks += 1
    for kind, seconds in tool.first:
        bill.act(kind, seconds)
    size_m = np.full(3, CUBE_M)
    fitted = aligned_box(xyz_m, truth.rotation)
    box = fitted if tool.fits else OrientedBox.from_parts(fitted.center_m, truth.rotation, size_m)
    bill.looks += 1
    for _ in range(MOST_ACTIONS):
        if iou_3d(box, truth) >= quality:
            return True
        (move, *_) = plan(box, truth, quality, offered)
        bill.act(move.kind, move.seconds)
        box = move.apply(box, truth, hand)
        bill.looks += 1
    return iou_3d(box, truth) >= quality


TAUGHT_FRAMES = 10


def is_project(path: Path) -> bool:
    """True for a project's folder."""
    return (path / "project.json").is_file()


@contextmanager
def copied(project: Path, folder: Path, name: str) -> Iterator[Project]:
    """A copy `folder/name` of a project, which the operator may change."""
    shutil.copytree(project, folder / name)
    with open_project(folder / name) as opened:
        yield opened


def teach(
    path: Path, folder: Path, rotation: BoxRotation, minutes: float | None, progress: ProgressCallback | None = None
) -> Path:
    """Makes a project of a recording with true boxes in `folder`, and teaches its detectors with ten frames, as the
    page orders them; returns the project's folder.

    `minutes` is the length of the view detector's training; None = the default.
    """
    recording = open_recording(path)
    if len(recording) < 2 * TAUGHT_FRAMES:
        raise ConfigError(
            f"{path}: has {len(recording)} frames; {TAUGHT_FRAMES} of them teach, and as many at least are reviewed"
        )
    truths = [load_truth(recording, index, recording.frame(index)) for index in range(len(recording))]
    classes = sorted({truth.label for each in truths for truth in each})
    if not classes:
        raise ConfigError(f"{path}: has no true boxes to teach and to review against")
    with create_project(folder, "taught", classes, settings=ProjectSettings(rotation=rotation)) as project:
        register_recording(project, recording)
        source = FrameSource(project)
        # the page's "Most useful first": far from each other
        for item in queue(project, Order.TEACH, most=TAUGHT_FRAMES).items:
            index = item.frame.index or 0
            objects = visible_objects(recording, index, source.read(item.frame), classes)
            new = [NewLabel(each.label, each.box) for each in objects]
            revision = item.frame.revision
            if new:
                revision = project.labels.create(item.frame.id, new, WriteContext(revision, AUTHOR)).receipt.revision
            project.frames.finalise(item.frame.id, WriteContext(revision, AUTHOR))
        train(project, TrainPlan(image=image_defaults(minutes), minutes=minutes), progress=progress)
        return project.path


def propose(project: Project, *, with_base: bool) -> None:
    """Proposes boxes for all frames that are not finalised, and links them into tracks, as `annotate` and `track` do.

    `with_base` lets the base detector measure them, in place of the project's own view detector.
    """
    image = active_model(project, DetectorKind.IMAGE)
    view = base_model() if with_base else view_model(project)
    detectors = Detectors(
        load_detector(image.path), load_detector(view.path), view.box_kind, view.class_agnostic, image.box_kind
    )
    annotate(project, detectors, rcv_config(project))
    link_tracks(project)


def measured_by(project: Project) -> list[str]:
    """Names the view detectors that measured the open proposals, for people."""
    own = {model.fingerprint: own_model(project, model).described for model in project.models.all(DetectorKind.VIEW)}
    base = base_titles(project)
    used = {each.run_id for each in project.labels.select(states=[ReviewState.PROPOSED])}
    return sorted({NAME if run.id in base else own[run.view_detector] for run in project.jobs.all() if run.id in used})


def without_labels(project: Project) -> None:
    """Deletes what a project's frames hold, and takes its own detectors out of use, so that the base detector measures
    boxes: a project as it begins.
    """
    for frame in project.frames.of():
        revision = frame.revision
        if frame.finalised:
            revision = project.frames.reopen(frame.id, WriteContext(revision, AUTHOR)).revision
        for label in project.labels.of_frame(frame.id):
            revision = project.labels.delete(frame.id, label.uid, WriteContext(revision, AUTHOR)).revision
    for role in DetectorKind:
        project.models.deactivate(role)
