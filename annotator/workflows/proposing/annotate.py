"""Proposes boxes for whole recordings: a batch that continues after a failed frame, and resumes when interrupted.

An engine does the work. This module sends it tasks, and stores the answers in the order of the frames. The number of
tasks in flight is limited (`Engine.window`), so memory does not grow with the answers.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

from annotator.project import StoredRecording, new_action
from annotator.project.audit.writing import WriteContext
from annotator.project.config import BoxRotation
from annotator.project.frames import StoredFrame
from annotator.project.jobs import Run
from annotator.project.project import Project
from annotator.project.proposals import RunShare
from annotator.rcv.config import REVISION, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.types import BoxKind, Source
from annotator.types.errors import ConfigError, FinalisedFrameError, HistoryError, ProjectError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing.runner import Engine, InlineEngine, failure
from annotator.workflows.proposing.still_votes import AUTHOR, vote_stills
from annotator.workflows.proposing.tasks import FrameAnswer, FrameSpec, Task, pickle_exactly
from annotator.workflows.recorded.adjusting import learn_up
from annotator.workflows.tracks.propose_boxes import followed_tracks, seeds_of

# Attempts to write a frame that is changed concurrently.
WRITE_ATTEMPTS = 5


@dataclass
class AnnotateSummary:
    """Counts of a batch.

    Attributes:
        skipped: frames left out: done before with the same detectors and settings, or finalised.
        backends: of the image and the view detector, e.g. ("openvino", "openvino").
        still: objects that stand still, each one proposal in place of those of the frames.
        learned: messages on up directions that reviewed boxes gave (`learn_up`).
    """

    frames: int = 0
    skipped: int = 0
    done: int = 0
    proposals: int = 0
    without: int = 0
    still: int = 0
    failed: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0
    backends: tuple[str, ...] = ()
    learned: tuple[str, ...] = ()

    @property
    def failures(self) -> int:
        return len(self.failed)


@dataclass(eq=False)
class Batch:
    """A batch, which is one action of its author, and its access to the store.

    Attributes:
        box_kind: what the proposed boxes enclose.
    """

    project: Project
    run: Run
    summary: AnnotateSummary
    box_kind: BoxKind
    author: str = AUTHOR
    action: str = field(default_factory=new_action)
    recordings: dict[int, StoredRecording] = field(default_factory=dict)

    def recording(self, recording_id: int) -> StoredRecording:
        """Returns a recording as it was when the batch began with it."""
        if recording_id not in self.recordings:
            stored = self.project.recordings.get(recording_id)
            self.project.recordings.require_readable(stored)
            self.recordings[recording_id] = stored
        return self.recordings[recording_id]

    def store(self, frame: StoredFrame, answer: FrameAnswer) -> None:
        if answer.result is None:
            self._fail(frame, answer)
            return
        try:
            self._replace(frame.id, answer.result, RunShare(self.run.id, answer.seconds))
        except FinalisedFrameError:  # finalised since the batch began
            self.summary.skipped += 1
            self.summary.frames -= 1
            return
        except HistoryError:  # undone since
            raise
        except Exception as error:
            self._fail(frame, failure(error, answer.seconds))
            return
        self.summary.done += 1
        self.summary.proposals += len(answer.result.proposals)
        self.summary.without += not answer.result.proposals

    def _replace(self, frame_id: int, result: FrameProposals, share: RunShare) -> None:
        for attempt in range(1, WRITE_ATTEMPTS + 1):
            frame, proposals = self.project.frames.get(frame_id), result.proposals
            self._require_unadjusted(frame.recording_id)
            context = WriteContext(frame.revision, self.author, Source.AUTO, maker=AUTHOR)
            tracks = followed_tracks(self.project, frame, proposals)
            try:
                self.project.proposals.replace(
                    frame_id,
                    proposals,
                    context,
                    run=share,
                    track_ids=tracks,
                    box_kind=self.box_kind,
                    action=self.action,
                )
                return
            except StaleRevisionError:
                # An operator has changed the frame. Proposals replace only unreviewed ones, so trying again is safe.
                if attempt == WRITE_ATTEMPTS:
                    raise

    def vote(self, progress: Progress | None = None) -> None:
        """Proposes what stands still once for all frames, in the recordings through which the batch has gone."""
        frames = self.summary.frames

        def beat(*_: int) -> None:
            if progress is not None:
                progress(frames, frames)

        if self.summary.done:
            gone_through = sorted(self.recordings)
            self.summary.still = vote_stills(self.project, gone_through, self.author, self.action, self.box_kind, beat)

    def _require_unadjusted(self, recording_id: int) -> None:
        """Refuses results that were found before the recording's cloud was moved, or its up direction changed."""
        stored, used = self.project.recordings.get(recording_id), self.recording(recording_id)
        if (stored.up, stored.correction) != (used.up, used.correction):
            raise ProjectError(
                f"the up direction or the calibration of {stored.name} was changed during the run; annotate it again"
            )

    def _fail(self, frame: StoredFrame, answer: FrameAnswer) -> None:
        reason = answer.reason or "unknown reason"
        self.project.jobs.record_failure(self.run.id, frame.id, reason, answer.seconds)
        self.summary.failed.append((frame.key, reason))


# Frames per task, which go through the recursion together: enough for full detector batches, few enough for memory.
TASK_FRAMES = 4
# Interval of progress calls while no task ends; a stop takes effect after this time at most.
HEARTBEAT_S = 0.5

Progress = Callable[[int, int], None]
"""Called with (frames done, frames to do). An exception that it raises ends the batch."""


def annotate(
    project: Project,
    detectors: Detectors,
    config: RcvConfig,
    *,
    recordings: Sequence[int] | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
) -> AnnotateSummary:
    """Runs `annotate_with` in this process."""
    engine = InlineEngine(detectors)
    return annotate_with(project, engine, config, recordings=recordings, limit=limit, progress=progress)


def annotate_with(
    project: Project,
    engine: Engine,
    config: RcvConfig,
    *,
    recordings: Sequence[int] | None = None,
    rotation: BoxRotation | None = None,
    limit: int | None = None,
    from_reviewed: bool = False,
    author: str = AUTHOR,
    progress: Progress | None = None,
) -> AnnotateSummary:
    """Proposes boxes for every frame that was not annotated with these detectors and settings before: one action.

    A failed frame is stored with the reason, and tried again by the next call; the others continue. Each frame is
    committed at once, so an interrupted call loses only the tasks in flight.

    Reviewed boxes may give the up direction of a recording first (`learn_up`).

    Args:
        engine: does the work; closed if an exception ends the batch, else it can be used again.
        config: the recursion's settings; set to the engine's detectors (`for_detector`), the orientation for each
            frame from `rotation`.
        recordings: ids; None = all.
        rotation: None = the project's setting.
        from_reviewed: if the previous frame is reviewed when a frame's task is made, the recursion starts from its
            boxes. Frames annotated with and without this setting count as different.
        author: who can undo it.
        progress: called after each stored task, and at intervals in between.
    """
    require_limit(limit)
    begin = time.perf_counter()
    pickle_exactly()  # for the seeds in tasks
    rotation = rotation or project.config.settings.rotation
    try:
        identity = engine.start()
        learned = learn_up(project, rotation, recordings)  # not if there are no detectors: nothing would say so
        config = config.for_detector(*identity.kinds)
        # the engine is not part of the description, since it does not affect the result
        own = {"rotation": rotation.value, "method": REVISION, "from_reviewed": from_reviewed}
        run = project.jobs.start(
            image_detector=identity.image, view_detector=identity.view, config_json=json.dumps(config.record() | own)
        )
        pending = project.jobs.pending(run.key, recordings)
        frames, skipped = pending[:limit], project.frames.count_present(recordings) - len(pending)
        summary = AnnotateSummary(frames=len(frames), skipped=skipped, backends=identity.backends, learned=learned)
        batch = Batch(project, run, summary, config.box_kind, author)
        _run_tasks(engine, _tasks(batch, frames, config, rotation, from_reviewed), batch, progress)
    except BaseException:
        engine.close()
        raise
    project.jobs.finish(run.id)
    batch.vote(progress)
    batch.summary.seconds = time.perf_counter() - begin
    return batch.summary


def require_limit(limit: int | None) -> None:
    if limit is not None and limit < 1:
        raise ConfigError(f"a limit of {limit} frames is too small; give 1 or more")


_SentTask = tuple[Task, tuple[StoredFrame, ...]]
"""A task and its frames."""


def _tasks(
    batch: Batch, pending: Sequence[StoredFrame], config: RcvConfig, rotation: BoxRotation, from_reviewed: bool
) -> Iterator[_SentTask]:
    """Yields the tasks of a batch, made on demand."""
    for number, first in enumerate(range(0, len(pending), TASK_FRAMES)):
        frames = tuple(pending[first : first + TASK_FRAMES])
        specs = tuple(
            FrameSpec(
                batch.recording(frame.recording_id), frame.key, seeds_of(batch.project, frame) if from_reviewed else ()
            )
            for frame in frames
        )
        yield Task(number, batch.project.path.name, specs, config, rotation), frames


def _run_tasks(engine: Engine, tasks: Iterator[_SentTask], batch: Batch, progress: Progress | None) -> None:
    """Sends tasks to an engine, and stores their answers in the order of the tasks."""
    in_flight: deque[_SentTask] = deque()
    answers: dict[int, tuple[FrameAnswer, ...]] = {}
    stored, total = 0, batch.summary.frames
    while True:
        for sent in islice(tasks, engine.window - len(in_flight)):
            engine.submit(sent[0])
            in_flight.append(sent)
        if not in_flight:
            return
        answer = engine.wait(HEARTBEAT_S)
        if answer is not None:
            answers[answer.number] = answer.frames
        elif progress is not None:
            progress(stored, total)
        while in_flight and in_flight[0][0].number in answers:
            task, frames = in_flight.popleft()
            for frame, result in zip(frames, answers.pop(task.number), strict=True):
                batch.store(frame, result)
            stored += len(frames)
            if progress is not None:
                progress(stored, total)
