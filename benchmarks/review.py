"""What it costs to review the boxes of a recording until each has an IoU with the true one: actions, and seconds.

    python -m benchmarks.review PROJECT|DIR [--quality 0.7] [--only proposals,base_detector,from_nothing,peers]
        [--minutes N] [--upright | --free] [--seed N] [--json]

A simulated operator (`review_operator`) does what the Review page offers, and a keystroke-level model (`keystrokes`)
says how long that takes. Of a recording, ten frames teach both detectors, and the others are reviewed. Of a project,
the frames without reviewed boxes are. The rows are
- `proposals`: what the project's detectors propose. With few reviewed objects on held-out frames, its training leaves
  the base detector in use, and the row equals the next one,
- `base_detector`: the same with the base detector in place of the project's view detector,
- `from_nothing`: no proposals and no taught detector: each object is drawn, and followed,
- `peers`: boxes drawn with other tools, walked through (`review_peers`).

Each row is reviewed frame by frame, and with contact sheets of tracks; the cheaper way gives the row's figures. An
object without a right box at the end counts as missed, a reviewed box that is right for no object as wrong. Waiting is
measured on this computer, and is part of the seconds. `view_detectors` names what measured the boxes of a row.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import tyro

from annotator.project import REVIEWED, Project
from annotator.types import ReviewState
from annotator.types.errors import ConfigError, DetectionError
from annotator.workflows.detectors import view_model
from benchmarks.report import QUIET, BoxOptions, Table, chosen, guarded, print_epoch, program
from benchmarks.review_moves import Bill, shaky
from benchmarks.review_operator import Operator
from benchmarks.review_peers import copied, is_project, measured_by, peers, propose, teach, without_labels

PARTS = ("proposals", "base_detector", "from_nothing", "peers")
# Whether contact sheets are used, by name.
WAYS = {"frame_by_frame": False, "contact_sheets": True}


@dataclass
class Arguments(BoxOptions):
    """Measure what the review of a recording costs an operator."""

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
    """Runs the benchmark; returns what `--json` prints."""
    parts = chosen("--only", args.only, PARTS)
    if not 0 < args.quality < 1:
        raise ConfigError(f"--quality is an IoU between 0 and 1, not {args.quality}")
    with TemporaryDirectory() as temporary:
        folder = Path(temporary)
        project = named if is_project(named := Path("projects") / args.path) else args.path
        if not is_project(project):
            kept = args.keep or folder / "taught"
            kept.mkdir(parents=True, exist_ok=True)
            project = teach(args.path, kept, args.rotation, args.minutes, print_epoch)
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
    with _prepared(part, project, folder) as (prepared, detectors):
        for way in WAYS:
            with copied(prepared, folder, f"{part}-{way}") as copy:
                ways[way] = _reviewed(args, copy, way)
    best = min(ways, key=lambda way: ways[way]["seconds_per_box"])
    return {"view_detectors": detectors, "way": best, **ways[best], "ways": ways}


@contextmanager
def _prepared(part: str, path: Path, folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """A project with what is to be reviewed, and the names of the view detectors that measure it."""
    with copied(path, folder, part) as project:
        if part == "from_nothing":
            without_labels(project)
        elif part == "base_detector" or not project.labels.count([ReviewState.PROPOSED]):
            propose(project, with_base=part == "base_detector")
        detectors = [view_model(project).described] if part == "from_nothing" else measured_by(project)
    yield folder / part, detectors


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
