"""Times the database of a large project: adding frames, writing and importing proposals, pending frames, statistics.

python -m benchmarks.store [--frames 10000] [--imported 100000] [--reviewed 10000] [--json]
"""

from __future__ import annotations

import json
import math
import resource
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from annotator.geometry.iou import iou_3d
from annotator.project import Effort, Project, RunShare, WriteContext, create_project, open_project
from annotator.project.changes import LabelChanged, NewLabel, Payload, ProposalsReplaced
from annotator.project.jobs import record_result
from annotator.project.log import Writer
from annotator.project.records import BoxRecord
from annotator.types import Box2D, OrientedBox, Proposal, Quality, ReviewState, Source
from annotator.workflows.importing import BoxFormat, import_proposals, read_labels
from annotator.workflows.workbench.review_queue import Order, queue
from benchmarks.report import Options, Table, guarded, program, require, seconds_of

LABEL = "person"
# As many as the page asks for.
MOST_ITEMS = 500


@dataclass
class Arguments(Options):
    frames: int = 10_000
    """Number of frames of the recording."""
    proposed: int = 200
    """Number of frames that get proposals."""
    objects: int = 3
    """Number of proposals in each of these frames."""
    reviewed: int = 0
    """Number of frames of another project, which people have reviewed: the time of its statistics."""
    imported: int = 100_000
    """Number of boxes of each of two detectors to import as proposals, spread over all frames."""


def run(args: Arguments) -> dict[str, float]:
    """Milliseconds by operation."""
    with TemporaryDirectory() as folder:
        return _measure(args, Path(folder))


def _measure(args: Arguments, folder: Path) -> dict[str, float]:
    require(args, 1, args.frames, "proposed")
    require(args, 0, math.inf, "objects", "imported", "reviewed")
    with create_project(folder, "long", (LABEL,)) as project:
        result = {"add_recording_ms": _milliseconds(lambda: _add(project, folder, args.frames))}
        run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}")
        proposals = [_proposal(2.0 * number) for number in range(args.objects)]
        context = WriteContext(0, "rcv", Source.AUTO)
        share = RunShare(run.id, 0.1)
        times = [
            _milliseconds(partial(project.proposals.replace, frame.id, proposals, context, run=share))
            for frame in project.frames.of()[: args.proposed]
        ]
        result["write_proposals_median_ms"] = statistics.median(times)
        result["pending_ms"] = _milliseconds(lambda: project.jobs.pending(run.key))
        result["statistics_ms"] = _milliseconds(project.statistics)
        for order in Order:
            result[f"queue_{order.value}_ms"] = _milliseconds(partial(queue, project, order, most=MOST_ITEMS))
        if args.imported:
            result |= _imports(project, folder, args.imported)
    return result | (_statistics(folder, args.reviewed) if args.reviewed else {})


def _statistics(folder: Path, frames: int) -> dict[str, float]:
    """Of a project with three reviewed boxes per frame, of which one was corrected, when the statistics are computed
    and when they are known."""
    boxes = [_proposal(2.0 * number).box for number in range(3)]
    iou_3d(boxes[0], boxes[0])  # loads the compiled code
    with create_project(folder, "worked", (LABEL,)) as project:
        _add(project, folder, frames)
        run = project.jobs.start(image_detector="a", view_detector="b", config_json="{}").id
        writer = Writer(project.store)
        with project.store.write() as connection:
            for number, frame in enumerate(project.frames.of()):
                uids = [f"{number}-{place}" for place in range(len(boxes))]
                proposed = [_proposal(2.0 * place + 0.1) for place in range(len(uids))]
                new = [
                    NewLabel(LABEL, each.box, state=ReviewState.PROPOSED, proposal=each, uid=uid)
                    for each, uid in zip(proposed, uids, strict=True)
                ]
                record_result(connection, run, frame.id, 0.1, time_ns=writer.store.clock(), proposals=len(proposed))
                replaced = ProposalsReplaced(proposed, new, run)
                writer.to_frame_in(connection, frame.id, [replaced], WriteContext(0, "rcv", Source.AUTO))
                decisions: list[Payload] = [LabelChanged(uid=uid, state=ReviewState.ACCEPTED) for uid in uids[1:]]
                decisions.append(LabelChanged(uid=uids[0], state=ReviewState.EDITED, box=BoxRecord.of(boxes[0])))
                for revision, decision in enumerate(decisions, 1):
                    context = WriteContext(revision, "ann", effort=Effort(1, 2.0))
                    writer.to_frame_in(connection, frame.id, [decision], context)
    with open_project(folder / "worked") as project:
        first = _milliseconds(project.statistics)
        return {"reviewed_statistics_ms": first, "known_statistics_ms": _milliseconds(project.statistics)}


def _imports(project: Project, folder: Path, boxes: int) -> dict[str, float]:
    """Imports two files with as many boxes; every second box of the second is an object of the first."""
    result: dict[str, float] = {}
    keys = [frame.key for frame in project.frames.of()]
    for number, name in enumerate(("first", "second")):
        file = folder / f"{name}.json"
        _write_boxes(file, keys, boxes, shift_m=0.01 * number, every_other_m=2.5 * number)
        before_mib, before_s = _peak_mib(), time.process_time()
        read = partial(read_labels, BoxFormat.BOXES, file)
        result[f"import_{name}_detector_ms"] = _milliseconds(lambda: import_proposals(project, read()))  # noqa: B023
        result[f"import_{name}_detector_cpu_ms"] = (time.process_time() - before_s) * 1000
        result[f"import_{name}_detector_mib"] = _peak_mib() - before_mib
    result["open_proposals"] = float(project.labels.count([ReviewState.PROPOSED]))
    for order in Order:
        result[f"queue_imported_{order.value}_ms"] = _milliseconds(partial(queue, project, order, most=MOST_ITEMS))
    return result


def _write_boxes(file: Path, keys: list[str], boxes: int, shift_m: float, every_other_m: float) -> None:
    share, more = divmod(boxes, len(keys))
    frames = {
        key: [
            {
                "label": LABEL,
                "center": [5.0 * n + shift_m + every_other_m * (n % 2), 40.1, 3.0],
                "size": [1.0, 0.7, 0.4],
                "rotation": np.eye(3).tolist(),
                "score": (index * 31 + n * 7) % 100 / 100,
            }
            for n in range(share + (index < more))
        ]
        for index, key in enumerate(keys)
    }
    file.write_text(json.dumps(frames))


def _peak_mib() -> float:
    """The largest memory that this process has had so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _add(project: Project, folder: Path, frames: int) -> None:
    project.recordings.add(folder / "recording", "rgbd", "long", [f"{n:06d}" for n in range(frames)], True)


def _proposal(x_m: float) -> Proposal:
    box = OrientedBox.from_parts(np.array([x_m, 0.1, 3.0]), np.eye(3), np.array([1.0, 0.7, 0.4]))
    return Proposal(LABEL, 0.8, box, Box2D(LABEL, 1.0, 2.0, 30.0, 40.0, 0.8), (), Quality(0.1, 0.9, 0.01, 0.8))


def _milliseconds(work: Callable[[], object]) -> float:
    return seconds_of(work) * 1000


def tables(_: Arguments, result: dict[str, float]) -> list[Table]:
    return [Table.of_figures(result)]


main = program(Arguments, run, tables, __doc__)


if __name__ == "__main__":
    guarded(main)
