"""Fake work for the tests of jobs, instead of proposing; `limit` selects its behaviour."""

from __future__ import annotations

import os
import signal
import time

from annotator.types.errors import DetectionError
from annotator.web.jobs.records import (
    CurvePoint,
    ImportRequest,
    JobContext,
    Outcome,
    ProposeRequest,
    TrainRequest,
)
from annotator.web.jobs.worker import AUTOGROUP

QUICK, REFUSED, BUG, KILLED, LONG, DEAF = range(1, 7)


def work(job: JobContext, request: ProposeRequest | ImportRequest) -> Outcome:
    """Behaves as selected by `request.limit`."""
    print("a library that prints")  # noqa: T201
    match getattr(request, "limit", QUICK):
        case 2:
            raise DetectionError("project room has no image detector yet")
        case 3:
            raise RuntimeError("the secret")
        case 4:
            job.progress("half way", 1, 2)
            os.kill(os.getpid(), signal.SIGKILL)
        case 5:
            for number in range(100_000):
                job.progress("on and on", float(number), 100_000.0)
                time.sleep(0.01)
        case 6:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            job.progress("deaf", 1, 2)
            time.sleep(600)
    job.progress("count", 1, 2)
    job.measured(CurvePoint(role="image", epoch=1, metrics={"map50": 0.5}))
    job.progress("count", 2, 2)
    (job.folder / "left.txt").write_text("x")
    # the file says nothing where Linux does not group this session's processes
    group = AUTOGROUP.read_text().split() if os.access(AUTOGROUP, os.W_OK) else []
    priority = {"nice": os.nice(0), "group": int(group[-1]) if group else None, "omp": os.environ["OMP_WAIT_POLICY"]}
    return Outcome("counted to 2", priority)


def train(job: JobContext, request: TrainRequest) -> Outcome:
    """Reports progress until it is stopped."""
    job.measured(CurvePoint(role="view", epoch=1, metrics={"map50": 0.5}))
    for number in range(100_000):
        job.progress("learn", float(number), 100_000.0)
        time.sleep(0.01)
    return Outcome("learned", {})
