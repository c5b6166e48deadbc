"""What it costs to label a recording whose camera moves, with its poses and without; and still objects of real ones.

    python -m benchmarks.world [--frames 200] [--only tour,drift,without_poses] [--seed N] [--json]
    python -m benchmarks.world DIR [--json]

Without DIR, tours of a room are generated, with exact poses (`tour`) and with poses that drift by 1 % of the way
(`drift`): twelve objects stand in it, and three people walk; and half as many scans from a car that passes 20 parked
and 6 moving ones, and walkers (`drive`), seen by a virtual camera that looks ahead. A simulated operator
(`review_operator`) does what the page and the commands offer. First, `annotate` goes through `--annotated` frames, with
image boxes that err by 3 % of their sides, and the base detector; what it proposes to stand still waits once in the
queue, and is accepted, corrected or rejected for all frames that see it. An object without a box is drawn, and
corrected. If it stands still, it gets a number, and is said to. A correction in any frame corrects it in all. What
moves is followed. `without_poses` is the work on the tour without its poses.

With DIR, a recording with its own boxes and poses (all its cameras, if it is a rig): each track is labelled in its
first moment alone, with the true box, and said to stand still where its true boxes lie within `STILL_M` in the world.
Its boxes in all later moments that see it are compared with the true ones; one that is missed has an IoU of 0.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from scipy.spatial.transform import RigidTransform

from annotator.detection.perfect import PerfectDetector, Scene
from annotator.geometry.iou import iou_3d
from annotator.project import REVIEWED, NewLabel, Origin, Project, StoredFrame, WriteContext, create_project
from annotator.project.changes import LabelChanged
from annotator.project.classes.edit import StyleClass
from annotator.project.records import BoxRecord
from annotator.project.rows import still_of
from annotator.recordings import ReaderOptions, Recording, open_recording
from annotator.recordings.look_around import RigCamera, Scanned
from annotator.recordings.poses import FILE_NAME, read_poses
from annotator.synthetic import write_generated
from annotator.types import OrientedBox, ReviewState
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import ALL, add_recordings
from annotator.workflows.detectors import Detectors, base_model, load_detector
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.tracks.operations import apply
from annotator.workflows.tracks.still_objects import StandStill, find_sightings, visible
from annotator.workflows.workbench.review_queue import Order, queue
from benchmarks.report import QUIET, Options, Table, chosen, guarded, program, require
from benchmarks.review_desk import AUTHOR, Thing, TrackKey
from benchmarks.review_moves import KEY_S, TYPE_S, Bill
from benchmarks.review_operator import CARE, Operator, meant_for

# An object stands still if the centres of its true boxes lie within this distance in the world.
STILL_M = 0.05
# A moment sees an object by so many points in its true box, on an image.
SEEN_POINTS = 5
# Error of the image boxes, share of their sides; and the least points of a detected object.
IMAGE_ERROR, LEAST_POINTS = 0.03, 60
# Virtual cameras around a LiDAR without cameras.
AROUND = 6
# A box is wrong that overlaps no object by this 3D IoU.
WRONG_IOU = 0.25


class Part(NamedTuple):
    """A generated recording: its preset, the drift of its poses, whether its classes stand still, and the tracks that
    do, from 1."""

    preset: str
    drift: float
    classes: dict[str, bool | None]
    still: int


ROOM: dict[str, bool | None] = {"object": True, "person": False}
PARTS = {
    "tour": Part("tour", 0.0, ROOM, 12),
    "drift": Part("tour", 0.01, ROOM, 12),
    "drive": Part("drive", 0.0, {"car": None, "person": False}, 20),
    "without_poses": Part("tour", 0.0, ROOM, 12),
}
WIDTH_PX, HEIGHT_PX = 320, 240
ERROR_PX = 2.0  # of the hand


@dataclass
class Arguments(Options):
    path: Annotated[Path | None, tyro.conf.Positional] = None
    """A recording with its own boxes and poses; default: generated ones."""
    frames: int = 200
    """Frames of a generated recording."""
    only: str = ",".join(PARTS)
    """Rows to measure, separated by commas."""
    annotated: int = 40
    """Frames through which `annotate` goes before; 0 = none, so that all is drawn."""
    quality: float = 0.75
    """3D IoU from which the operator leaves a box as it is."""
    seed: int = 0
    """Seed of the recordings, and of the hand's errors."""


def run(args: Arguments) -> dict[str, Any]:
    parts = chosen("--only", args.only, PARTS)
    require(args, 2, 10_000, "frames")
    with TemporaryDirectory() as temporary:
        if args.path is not None:
            return {"still": still_objects(args.path, Path(temporary))}
        return {part: _generated(args, part, Path(temporary)) for part in parts}


# --- a recording with its own boxes -----------------------------------------------------------------------------------


class Seen(NamedTuple):
    """A true box in a frame that sees it."""

    frame: StoredFrame
    box: OrientedBox


def still_objects(path: Path, folder: Path) -> dict[str, Any]:
    """Labels each track in its first moment, and compares what later moments show of those that stand still."""
    recording, options = open_recording(path), ReaderOptions()
    if recording.pose_source is None:
        raise ConfigError(f"{path}: says nothing of where its camera was")
    if isinstance(recording, Scanned) and not getattr(recording, "cameras", ()):
        options = ReaderOptions(look_around=AROUND)  # no camera saw it
        recording = open_recording(path, options)
    cameras = recording.cameras if isinstance(recording, RigCamera) else ()
    opened = [open_recording(path, options.model_copy(update={"camera": each})) for each in cameras] or [recording]
    truths = [load_truth(each, index, each.frame(index)) for each in opened for index in range(len(each))]
    if not (labels := sorted({truth.label for each in truths for truth in each})):
        raise ConfigError(f"{path}: has no true boxes")
    with create_project(folder, "still", labels) as project:
        add_recordings(project, [path], options=options, cameras=(ALL,) if cameras else ())
        tracks = {key: seen for key, seen in _seen(project).items() if stands_still(project, seen)}
        first = project.recordings.all()[0].id
        for track_id, (key, seen) in enumerate(sorted(tracks.items()), 1):
            frame, box = seen[0]
            new = NewLabel(key[0], box, track_id=track_id)
            project.labels.create(frame.id, [new], WriteContext(project.frames.get(frame.id).revision, AUTHOR))
            apply(project, frame.recording_id, track_id, StandStill(frame=frame.id), AUTHOR)
        find_sightings(project, first, progress=lambda done, of: QUIET.print(f"{done} of {of} moments"))
        ious = [
            best_of(project, track_id, seen, moment)
            for track_id, (_, seen) in enumerate(sorted(tracks.items()), 1)
            for moment in dict.fromkeys(each.frame.moment_id for each in seen[1:])
            if moment != seen[0].frame.moment_id
        ]
    return {"tracks": len(tracks), "boxes": len(ious), **_figures(ious)}


def _seen(project: Project) -> dict[TrackKey, list[Seen]]:
    """The frames that see each track, in time order, with its true boxes there."""
    found, source = defaultdict[TrackKey, list[Seen]](list), FrameSource(project)
    frames = [frame for frame in project.frames.of() if frame.index is not None]
    for frame in sorted(frames, key=lambda each: each.index or 0):
        read = source.read(frame)
        for truth in load_truth(source.recording(frame.recording_id), frame.index or 0, read):
            if truth.track_id is not None and visible(read, truth.box)[0] >= SEEN_POINTS:
                found[truth.label, truth.track_id].append(Seen(frame, truth.box))
    return found


def stands_still(project: Project, seen: Sequence[Seen]) -> bool:
    """Whether the centres of a track's true boxes in several moments lie within `STILL_M` in the world."""
    poses = {id: project.stills.poses(id) for id in {each.frame.recording_id for each in seen}}
    places = [(each.box, poses[each.frame.recording_id].get(each.frame.id)) for each in seen]
    centers = [T.inv().apply(box.center_m) for box, T in places if T is not None]
    if len(centers) < len(seen) or len({each.frame.moment_id for each in seen}) < 2:
        return False
    return bool(np.linalg.norm(np.stack(centers) - centers[0], axis=1).max() < STILL_M)


def best_of(project: Project, track_id: int, seen: Sequence[Seen], moment: int) -> float:
    """IoU of a track's box in a moment with the true one, in the frames that see it; 0 if it is missed."""
    there = [each for each in seen if each.frame.moment_id == moment]
    shown = {label.track_id: label.box for label in project.labels.of_frame(there[0].frame.id)}
    return iou_3d(shown[track_id], there[0].box) if track_id in shown else 0.0


def _figures(ious: Sequence[float]) -> dict[str, float | None]:
    """Mean IoU with missed boxes as 0, and the share of them."""
    return {
        "mean_iou": float(np.mean(ious)) if ious else None,
        "missed": float(np.mean([iou == 0.0 for iou in ious])) if ious else None,
    }


# --- generated recordings ---------------------------------------------------------------------------------------------


class Traveller(Operator):
    """The operator of `review_operator`, who also says which of the true tracks stand still (none without poses)."""

    def __init__(self, project: Project, args: Arguments, still: set[TrackKey]) -> None:
        super().__init__(project, project.frames.of(), args.quality, ERROR_PX, args.seed)
        self.still = still

    def review_stills(self) -> None:
        """Takes what is proposed to stand still from the queue, each in the frame that sees most of it."""
        for item in queue(self.desk.project, Order.WORST).items:
            if item.uid is None or still_of(item.uid) is None:
                continue
            self.desk.enter(item.frame)
            (label,) = (each for each in self.desk.labels(item.frame) if each.uid == item.uid)
            thing = meant_for([label], self.desk.things(item.frame)).get(label.uid)
            bill = self.desk.bills[next(iter(self.still)) if thing is None else thing.key]
            self.desk.look(item.frame, label.box, bill, is_ahead=True)
            if thing is None or thing.key not in self.still:
                bill.act("reject", KEY_S)
                change = LabelChanged(uid=label.uid, state=ReviewState.REJECTED)
            else:
                is_right = self.desk.is_right(label, thing)
                margin = 0.0 if is_right else CARE
                box, _ = self._corrections.corrected(
                    item.frame, label.box, thing, bill, can_redraw=False, margin=margin
                )
                bill.act("accept", KEY_S)
                accept = LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED)
                change = accept if is_right else edited(label.uid, box)
            self.desk.store(item.frame, [change])

    def _draw_missing(self, frame: StoredFrame, thing: Thing) -> None:
        """Draws an object; one that stands still gets a number, and is in all frames that see it."""
        if thing.key not in self.still:
            super()._draw_missing(frame, thing)
            return
        project, bill = self.desk.project, self.desk.bills[thing.key]
        if (box := self._corrections.drawn(frame, thing, bill)) is None:
            return
        self.desk.look(frame, box, bill)
        box, _ = self._corrections.corrected(frame, box, thing, bill, can_redraw=False, margin=CARE)
        track_id = project.labels.next_track_id(frame.recording_id)
        self.desk.store(frame, [NewLabel(thing.label, box, track_id=track_id, origin=Origin.DRAWN)])
        bill.act("accept", KEY_S)
        bill.act("number", TYPE_S)
        bill.act("stands still", KEY_S)
        apply(project, frame.recording_id, track_id, StandStill(frame=frame.id), AUTHOR)

    def _review_frame(self, frame: StoredFrame) -> None:
        """Corrects what stands still where the frame shows that its box is not right, draws, and looks where else."""
        if self.still:
            self._correct_still(frame)
        before = len(self.desk.project.stills.of(frame.recording_id))
        super()._review_frame(frame)
        if len(self.desk.project.stills.of(frame.recording_id)) > before:
            find_sightings(self.desk.project, frame.recording_id, near=frame.id)

    def _correct_still(self, frame: StoredFrame) -> None:
        """A box that fits less well from here is corrected for all frames."""
        things = [thing for thing in self.desk.things(frame) if thing.due and thing.key in self.still]
        for stored in self.desk.project.labels.of_moment(frame.id):
            label = stored.label
            thing = max(things, key=lambda each: iou_3d(label.box, each.box), default=None)
            if stored.still is None or thing is None or not 0 < iou_3d(label.box, thing.box) < self.desk.quality:
                continue
            bill = self.desk.bills[thing.key]
            box, _ = self._corrections.corrected(frame, label.box, thing, bill, can_redraw=False, margin=CARE)
            self.desk.store(frame, [edited(label.uid, box)])


def edited(uid: str, box: OrientedBox) -> LabelChanged:
    """An operator's correction of a box."""
    return LabelChanged(uid=uid, state=ReviewState.EDITED, box=BoxRecord.of(box))


def _generated(args: Arguments, part: str, folder: Path) -> dict[str, Any]:
    path = folder / part
    made = PARTS[part]
    frames = args.frames // 2 if made.preset == "drive" else args.frames
    write_generated(path, made.preset, frames, args.seed, WIDTH_PX, HEIGHT_PX, drift=made.drift)
    recording = open_recording(path)
    true_poses = read_poses(path / "truth", recording.keys, None) if made.drift else None
    found = [true_poses.at(i, None) if true_poses else recording.pose(i) for i in range(len(recording))]
    poses = [T for T in found if T is not None]
    still = {(next(iter(made.classes)), track) for track in range(1, made.still + 1)}
    if part == "without_poses":
        (path / FILE_NAME).unlink()
    with create_project(folder, f"{part}_project", tuple(made.classes)) as project:
        for name, is_still in made.classes.items():
            project.change_classes(StyleClass(name=name, style={"still": is_still}), AUTHOR)
        add_recordings(project, [path])
        if args.annotated:
            annotate(project, _detectors(recording, args.seed), rcv_config(project), limit=args.annotated)
        operator = Traveller(project, args, still if part != "without_poses" else set())
        operator.review_stills()
        operator.review(with_sheets=False)
        return _counted(operator, still, poses)


def _detectors(recording: Recording, seed: int) -> Detectors:
    """True boxes on the images with an error, and the base detector."""
    frames = (recording.frame(index) for index in range(len(recording)))
    scenes = [Scene.of(frame, load_truth(recording, index, frame)) for index, frame in enumerate(frames)]
    image, base = PerfectDetector(scenes, jitter=IMAGE_ERROR, seed=seed, min_points=LEAST_POINTS), base_model()
    return Detectors(image, load_detector(base.path), base.box_kind, base.class_agnostic)


def _counted(operator: Traveller, still: set[TrackKey], poses: Sequence[RigidTransform]) -> dict[str, Any]:
    """Actions a box of what stands still and what moves, and how good all boxes are at the end.

    Args:
        poses: of the frames. Where a thing stands that hardly shows, so that the frame has no true box, one is right.
    """
    boxes, ious, wrong = defaultdict[bool, int](int), list[float](), 0
    stand = dict[TrackKey, OrientedBox]()
    for frame, T in zip(operator.desk.frames, poses, strict=True):
        stand |= {each.key: each.box.transformed(T) for each in operator.desk.things(frame) if each.key in still}
    for frame, T in zip(operator.desk.frames, poses, strict=True):
        things, labels = operator.desk.things(frame), operator.desk.labels(frame)
        reviewed = [label for label in labels if label.state in REVIEWED]
        for thing in (each for each in things if each.due):
            of_class = [label.box for label in reviewed if label.label == thing.label]
            boxes[thing.key in still] += 1
            ious.append(max((iou_3d(box, thing.box) for box in of_class), default=0.0))
        true = [thing.box for thing in things] + [box.transformed(T.inv()) for box in stand.values()]
        wrong += sum(all(iou_3d(label.box, box) < WRONG_IOU for box in true) for label in reviewed)
    bills = {kind: Bill() for kind in (True, False)}
    for key, bill in operator.desk.bills.items():
        bills[key in still] += bill
    rows = {"still": True, "moving": False}
    return {
        **{f"actions_per_box_{name}": bills[of].count / max(boxes[of], 1) for name, of in rows.items()},
        **{f"boxes_{name}": boxes[of] for name, of in rows.items()},
        "seconds_per_box": sum(bill.seconds for bill in bills.values()) / max(len(ious), 1),
        **_figures(ious),
        "wrong": wrong,
        "by_kind": {name: bills[of].by_kind for name, of in rows.items()},
    }


def tables(args: Arguments, result: dict[str, Any]) -> list[Table]:
    return [Table.of_figures({f"{part}, {name}": value for name, value in row.items()}) for part, row in result.items()]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
