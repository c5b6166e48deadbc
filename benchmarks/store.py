"""Times the database of a large project: adding frames, writing proposals, querying the pending frames.

python -m benchmarks.store [--frames 10000] [--json]
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro

from annotator.project import Project, RunShare, WriteContext, create_project
from annotator.types import Box2D, OrientedBox, Proposal, Quality, Source
from annotator.types.errors import ConfigError
from annotator.workflows.workbench.review_queue import Order, queue
from benchmarks.report import Table, finish, guarded

LABEL = "person"


@dataclass
class Arguments:
    """Time each operation on a project with one long recording; for writing proposals, the median over the frames."""

    frames: int = 10_000
    """Number of frames of the recording."""
    proposed: int = 200
    """Number of frames that get proposals."""
    objects: int = 3
    """Number of proposals in each of these frames."""
    json: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object as the last line."""


def run(args: Arguments, folder: Path) -> dict[str, float]:
    """Milliseconds by operation.

    Raises:
        ConfigError: a number out of its range.
    """
    if not 1 <= args.proposed <= args.frames or args.objects < 0:
        raise ConfigError(f"--proposed must be 1 to --frames ({args.frames}), --objects 0 or more")
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
            result[f"queue_{order.value}_ms"] = _milliseconds(partial(queue, project, order))
        return result


def _add(project: Project, folder: Path, frames: int) -> None:
    project.recordings.add(folder / "recording", "rgbd", "long", [f"{n:06d}" for n in range(frames)], True)


def _proposal(x_m: float) -> Proposal:
    box = OrientedBox.from_parts(np.array([x_m, 0.1, 3.0]), np.eye(3), np.array([1.0, 0.7, 0.4]))
    return Proposal(LABEL, 0.8, box, Box2D(LABEL, 1.0, 2.0, 30.0, 40.0, 0.8), (), Quality(0.1, 0.9, 0.01, 0.8))


def _milliseconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return (time.perf_counter() - began) * 1000


def main() -> None:
    args = tyro.cli(Arguments, description=__doc__)
    with TemporaryDirectory() as temporary:
        result = run(args, Path(temporary))
    table = Table("operation", "ms")
    for name, value in result.items():
        table.add(name.removesuffix("_ms"), value)
    finish(result, args.json, table)


if __name__ == "__main__":
    guarded(main)
