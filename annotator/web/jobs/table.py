"""The kinds of jobs: kind -> "module:function" of the work. A function takes a `Desk` and its request."""

from __future__ import annotations

WORK: dict[str, str] = {
    "train": "annotator.web.jobs.work:train_work",
    "propose": "annotator.web.jobs.work:propose_work",
    "export": "annotator.web.jobs.work:export_work",
    "import": "annotator.web.jobs.work:import_work",
}
