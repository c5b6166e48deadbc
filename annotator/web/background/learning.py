"""Learning while somebody labels: rounds of training in the background, which step aside for drawing and other jobs."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from starlette.types import ASGIApp, Receive, Scope, Send

from annotator.project import REVIEWED, Project
from annotator.types import DetectorKind
from annotator.web.jobs.records import TrainRequest
from annotator.web.jobs.runner import JobRunner
from annotator.workflows.training.model_report import decision_of

OPERATOR = "learning while labelling"
ROUND = TrainRequest(kind="train", roles=[DetectorKind.VIEW], background=True)


class Learner:
    """Starts a round for a project once enough boxes were reviewed since the last one."""

    def __init__(self, jobs: JobRunner) -> None:
        self._jobs = jobs
        # number of reviewed boxes when the last round began
        self._learned = WeakKeyDictionary[Project, int]()
        # the last round's job, and the number before it
        self._rounds = WeakKeyDictionary[Project, tuple[str, int]]()

    def look(self, name: str, project: Project) -> None:
        """Starts a round of a project if it is due and no other job runs or waits.

        A round that stepped aside for another job is started again afterwards.
        """
        every = project.config.settings.learn_every
        if every is None:
            self._learned.pop(project, None)
            return
        reviewed = project.labels.count(REVIEWED)
        if project not in self._learned:
            self._learned[project] = _learned(project, reviewed)
        learned = self._learned[project]
        if project in self._rounds and self._jobs.stepped_aside(self._rounds[project][0]):
            self._learned[project] = learned = self._rounds.pop(project)[1]
        if reviewed - learned < every or not self._jobs.is_idle():
            return
        # a training that somebody started has learned, too
        learned = self._learned[project] = max(learned, _learned(project, learned))
        if reviewed - learned >= every:
            job = self._jobs.add(name, project.path, ROUND, OPERATOR)
            self._rounds[project] = (job.id, learned)
            self._learned[project] = reviewed


def _learned(project: Project, reviewed: int) -> int:
    """The number of reviewed boxes when the training of the newest detector began; 0 without a detector.

    Args:
        reviewed: the number that counts for a detector without a record of it.
    """
    models = project.models.all(DetectorKind.VIEW)
    if not models:
        return 0
    decision = decision_of(models[-1])
    return reviewed if decision is None or decision.reviewed is None else decision.reviewed


class StepAside:
    """ASGI middleware: a job in the background waits while the server answers requests about a frame."""

    def __init__(self, app: ASGIApp, jobs: JobRunner) -> None:
        self.app, self._jobs = app, jobs

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on."""
        if scope["type"] != "http" or "/frames/" not in scope["path"]:
            await self.app(scope, receive, send)
            return
        with self._jobs.stepping_aside():
            await self.app(scope, receive, send)
