"""What it costs to review the boxes of a recording until each has an IoU with the true one: actions, and seconds.

    python -m benchmarks.review PROJECT|DIR [--quality 0.7] [--only proposals,base_detector,from_nothing,peers]
        [--minutes N] [--upright | --free] [--seed N] [--json]

A simulated operator (`review_operator`) does what the Review page offers, and a keystroke-level model (`review_moves`)
says how long that takes. Of a recording, ten frames teach both detectors, and the others are reviewed. Of a project,
the frames without reviewed boxes are. The rows are
- `proposals`: what the project's detectors propose. With few reviewed objects on held-out frames, its training leaves
  the base detector in use, and the row equals the next one,
- `base_detector`: the same with the base detector in place of the project's view detector,
- `from_nothing`: no proposals and no taught detector: each object is drawn, and followed,
- `peers`: boxes drawn with other tools, walked through (`review_moves`).

Each row is reviewed frame by frame, and with contact sheets of tracks; the cheaper way gives the row's figures. An
object without a right box at the end counts as missed, a reviewed box that is right for no object as wrong. Waiting is
measured on this computer, and is part of the seconds. `view_detectors` names what measured the boxes of a row.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro

from annotator.detection.pretrained import NAME
from annotator.project import (
    REVIEWED,
    BoxRotation,
    NewLabel,
    Project,
    ProjectSettings,
    WriteContext,
    create_project,
    open_project,
)
from annotator.recordings import open_recording
from annotator.types import DetectorKind, ReviewState
from annotator.types.errors import ConfigError, DetectionError
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors, base_model, base_titles, load_detector, own_model, required_model
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.proposing.annotate import annotate
from annotator.workflows.recorded.reading import load_truth
from annotator.workflows.settings import rcv_config
from annotator.workflows.simulate import visible_objects
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.training.train import TrainPlan, image_defaults, train
from annotator.workflows.workbench.review_queue import Order, queue
from benchmarks.report import QUIET, BoxOptions, Table, chosen, guarded, print_epoch, program
from benchmarks.review_desk import AUTHOR
from benchmarks.review_moves import Bill, peers, shaky
from benchmarks.review_operator import Operator

PARTS = ("proposals", "base_detector", "from_nothing", "peers")
TAUGHT_FRAMES = 10
# Whether contact sheets are used, by name.
WAYS = {"frame_by_frame": False, "contact_sheets": True}


@dataclass
class Arguments(BoxOptions):
    path: Annotated[Path, tyro.conf.Positional]
    """A recording with true boxes; or a project of such recordings, by its folder or, in ./projects, by its name."""
    quality: float = 0.7
    """3D IoU from which a box is right."""
    error_px: float = 2.0
    """Error of the hand, standard deviation in pixels of a picture."""
    only: str = ",".join(PARTS)
    """Rows to measure, separated by commas."""
    minutes: float | None = None
    """Length of the view detector's training, minutes; None = the default."""
    keep: Path | None = None
    """Folder in which to keep the taught project, which PATH can name the next time."""
    seed: int = 0
    """Seed of the hand's errors."""


def run(args: Arguments) -> dict[str, Any]:
    parts = chosen("--only", args.only, PARTS)
    if not 0 < args.quality < 1:
        raise ConfigError(f"--quality is an IoU between 0 and 1, not {args.quality}")
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        project = named if is_project(named := Path("projects") / args.path) else args.path
        if not is_project(project):
            kept = args.keep or folder / "taught"
            kept.mkdir(parents=True, exist_ok=True)
            project = teach(args.path, kept, args.rotation, args.minutes)
        rows: dict[str, Any] = {}
        for part in (part for part in PARTS if part in parts):
            try:
                rows[part] = _row(args, part, project, folder)
            except DetectionError as error:  # for proposals the project needs an image detector
                QUIET.print(f"{part}: left out, because {error}")
        return rows


def _row(args: Arguments, part: str, project: Path, folder: Path) -> dict[str, Any]:
    if part == "peers":
        hand = shaky(np.random.default_rng(args.seed), args.error_px)
        with copied(project, folder, "peers") as copy:
            objects = [(thing.box, xyz_m) for each in _operators(args, copy) for thing, xyz_m in each.due_objects()]
            return peers(objects, args.quality, hand)
    ways: dict[str, dict[str, Any]] = {}
    prepared, detectors = _prepared(part, project, folder)
    for way in WAYS:
        with copied(prepared, folder, f"{part}-{way}") as copy:
            ways[way] = _reviewed(args, copy, way)
    best = min(ways, key=lambda way: ways[way]["seconds_per_box"])
    return {"view_detectors": detectors, "way": best, **ways[best], "ways": ways}


def _prepared(part: str, path: Path, folder: Path) -> tuple[Path, list[str]]:
    """A project with what is to be reviewed, and the names of the view detectors that measure it."""
    with copied(path, folder, part) as project:
        if part == "from_nothing":
            without_labels(project)
        elif part == "base_detector" or not project.labels.count([ReviewState.PROPOSED]):
            propose(project, with_base=part == "base_detector")
        detectors = (
            [required_model(project, DetectorKind.VIEW).described] if part == "from_nothing" else measured_by(project)
        )
    return folder / part, detectors


def _reviewed(args: Arguments, project: Project, way: str) -> dict[str, Any]:
    """Reviews all frames without reviewed boxes; returns the figures."""
    tracks: list[dict[str, Any]] = []
    total, boxes, missed, wrong = Bill(), 0, 0, 0
    for operator in _operators(args, project):
        operator.review(WAYS[way])
        left = operator.left()
        boxes, missed, wrong = boxes + left.boxes, missed + left.missed, wrong + left.wrong
        total = sum(operator.desk.bills.values(), total)
        due = Counter(thing.key for thing, _ in operator.due_objects())
        for label, track in sorted(due):
            bill = operator.desk.bills[label, track]
            effort = {"actions": bill.count, "seconds": bill.seconds}
            tracks.append({"label": label, "track": track, "boxes": due[label, track], **effort})
    if not boxes:
        raise ConfigError(f"{args.path}: there is no visible object of the project's classes in the frames to review")
    return {
        "boxes": boxes,
        "actions_per_box": total.count / boxes,
        "seconds_per_box": total.seconds / boxes,
        "waiting_per_box": total.waiting_s / boxes,
        "looks_per_box": total.looks / boxes,
        "by_kind": total.by_kind,
        "missed": missed,
        "wrong": wrong,
        "failures": (missed + wrong) / boxes,
        "tracks": tracks,
    }


def _operators(args: Arguments, project: Project) -> Iterator[Operator]:
    """An operator for each recording, with the frames that have no reviewed box."""
    done = project.labels.frames(states=REVIEWED)
    for recording in project.recordings.all():
        stored = project.frames.of([recording.id])
        frames = [f for f in stored if f.index is not None and not f.finalised and f.id not in done]
        if frames:
            yield Operator(project, frames, args.quality, args.error_px, args.seed)


def is_project(path: Path) -> bool:
    """True for a project's folder."""
    return (path / "project.json").is_file()


@contextmanager
def copied(project: Path, folder: Path, name: str) -> Iterator[Project]:
    """A copy `folder/name` of a project, which the operator may change."""
    shutil.copytree(project, folder / name)
    with open_project(folder / name) as opened:
        yield opened


def teach(path: Path, folder: Path, rotation: BoxRotation, minutes: float | None) -> Path:
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
        train(project, TrainPlan(image=image_defaults(minutes), minutes=minutes), progress=print_epoch)
        return project.path


def propose(project: Project, *, with_base: bool) -> None:
    """Proposes boxes for all frames that are not finalised, and links them into tracks, as `annotate` and `track` do.

    `with_base` lets the base detector measure them, in place of the project's own view detector.
    """
    image = required_model(project, DetectorKind.IMAGE)
    view = base_model() if with_base else required_model(project, DetectorKind.VIEW)
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


def tables(_: Arguments, result: dict[str, Any]) -> list[Table]:
    table = Table("row", "measured by", "way", "boxes", "actions a box", "s a box", "of it waiting", "failures")
    kinds = Table("row", "way", "what was done", "times")
    tracks = Table("row", "way", "class", "track", "boxes", "actions", "seconds")
    for part, row in result.items():
        if part == "peers":
            for name, figures in row.items():
                table.add(name, "", "drawn", "", figures["actions_per_box"], figures["seconds_per_box"], "", "")
            continue
        for way, figures in row["ways"].items():
            numbers = ("boxes", "actions_per_box", "seconds_per_box", "waiting_per_box", "failures")
            table.add(part, ", ".join(row["view_detectors"]), way, *(figures[name] for name in numbers))
            for kind, times in figures["by_kind"].items():
                kinds.add(part, way, kind, times)
            for track in figures["tracks"]:
                tracks.add(part, way, *track.values())
    return [table, kinds, tracks]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
