"""Work for the tests of the jobs, in place of proposing: `limit` says what shall become of it."""

from __future__ import annotations

import os
import signal
import time

from annotator.project import Change
from annotator.types import Source
from annotator.types.errors import DetectionError
from annotator.web.jobs.desk import Desk, Outcome
from annotator.web.jobs.records import CurvePoint, ProposeRequest

QUICK, REFUSED, BUG, KILLED, LONG, DEAF, EDITS = range(1, 8)


def work(desk: Desk, request: ProposeRequest) -> Outcome:
    """Does as it is told."""
    print("a library that prints")  # noqa: T201
    match request.limit:
        case 2:
            raise DetectionError("project room has no image detector yet")
        case 3:
            raise RuntimeError("the secret")
        case 4:
            desk.progress("half way", 1, 2)
            os.kill(os.getpid(), signal.SIGKILL)
        case 5:
            for number in range(10_000):
                desk.progress("on and on", float(number), 10_000.0)
                time.sleep(0.01)
        case 6:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            desk.progress("deaf", 1, 2)
            time.sleep(600)
        case 7:
            frame = desk.project.frames.of()[0]
            desk.project.frames.finalise(frame.id, Change(frame.revision, "a job", Source.MANUAL))
    desk.progress("count", 1, 2)
    desk.measured(CurvePoint(role="image", epoch=1, metrics={"map50": 0.5}))
    desk.progress("count", 2, 2)
    (desk.folder / "left.txt").write_text("x")
    return Outcome("counted to 2", {"nice": os.nice(0), "omp": os.environ["OMP_WAIT_POLICY"]})
