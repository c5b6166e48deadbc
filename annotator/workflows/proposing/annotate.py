"""Proposes boxes for whole recordings: a batch that continues after a failed frame, and resumes when interrupted.

An engine (`proposing/engines`) does the work. This module sends it tasks, and stores the answers in the order of the
frames. The number of tasks in flight is limited (`Engine.window`), so memory does not grow with the recording.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from annotator.project.config import BoxRotation
from annotator.project.frames import StoredFrame
from annotator.project.project import Project
from annotator.rcv.config import REVISION, RcvConfig
from annotator.types.errors import ConfigError
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing.batch_store import AnnotateSummary, Batch
from annotator.workflows.proposing.engines.engine import Engine
from annotator.workflows.proposing.engines.inline import InlineEngine
from annotator.workflows.proposing.engines.sources import GivenDetectors
from annotator.workflows.proposing.engines.tasks import FrameAnswer, FrameSpec, Identity, Task, pickle_exactly
from annotator.workflows.recorded.adjusting import learn_up
from annotator.workflows.tracks.previous_boxes import seeds_of

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
    rotation: BoxRotation | None = None,
    limit: int | None = None,
    progress: Progress | None = None,
) -> AnnotateSummary:
    """Runs `annotate_with` in this process."""
    engine = InlineEngine(GivenDetectors(detectors))
    return annotate_with(
        project, engine, config, recordings=recordings, rotation=rotation, limit=limit, progress=progress
    )


def annotate_with(
    project: Project,
    engine: Engine,
    config: RcvConfig,
    *,
    recordings: Sequence[int] | None = None,
    rotation: BoxRotation | None = None,
    limit: int | None = None,
    from_reviewed: bool = False,
    progress: Progress | None = None,
) -> AnnotateSummary:
    """Proposes boxes for every frame that was not annotated with these detectors and settings before.

    A failed frame is stored with the reason, and tried again by the next call; the others continue. Each frame is
    committed at once, so an interrupted call loses only the tasks in flight.

    Reviewed boxes may give the up direction of a recording first (`learn_up`).

    Args:
        engine: does the work; closed if an exception ends the batch, else it can be used again.
        config: the recursion's settings; set to the engine's detectors (`for_detector`), the orientation for each
            frame from `rotation`.
        recordings: ids; None = all.
        rotation: None = the project's setting.
        limit: maximum number of frames.
        from_reviewed: if the previous frame is reviewed when a frame's task is made, the recursion starts from its
            boxes. Frames annotated with and without this setting count as different.
        progress: called after each stored task, and at intervals in between.

    Raises:
        ConfigError: a limit below 1.
        ProjectError: the store refuses even the record of a failed frame.
        WorkerError: the engine's workers keep dying.
    """
    require_limit(limit)
    begin = time.perf_counter()
    pickle_exactly()  # for the seeds in tasks
    rotation = rotation or project.config.settings.rotation
    try:
        identity = engine.start()
        learned = learn_up(project, rotation, recordings)  # not if there are no detectors: nothing would say so
        kinds = (identity.box_kind, identity.class_agnostic, identity.image_kind)
        config = config.for_detector(*kinds, identity.trained)
        run = project.jobs.start(**_description(identity, config, rotation, from_reviewed))
        present, pending = project.frames.count_present(recordings), project.jobs.count_pending(run.key, recordings)
        frames = pending if limit is None else min(pending, limit)
        summary = AnnotateSummary(frames=frames, skipped=present - pending, backends=identity.backends, learned=learned)
        batch = Batch(project, run, frames, recordings, summary, config.box_kind)
        tasks = _tasks(batch, config, rotation, from_reviewed)
        _run_tasks(engine, tasks, batch, progress)
    except BaseException:
        engine.close()
        raise
    project.jobs.finish(run.id)
    batch.summary.seconds = time.perf_counter() - begin
    return batch.summary


def require_limit(limit: int | None) -> None:
    """Checks a limit.

    Raises:
        ConfigError: it is below 1.
    """
    if limit is not None and limit < 1:
        raise ConfigError(f"a limit of {limit} frames is too small; give 1 or more")


def _description(identity: Identity, config: RcvConfig, rotation: BoxRotation, from_reviewed: bool) -> dict[str, str]:
    """Returns a run's detectors and settings. The engine is not part of them, since it does not affect the result."""
    settings = {
        **config.record(),
        "rotation": rotation.value,
        "method": REVISION,
        # absent if False, so that frames annotated before this setting existed are not annotated again
        **({"from_reviewed": True} if from_reviewed else {}),
    }
    return {
        "image_detector": identity.image,
        "view_detector": identity.view,
        "config_json": json.dumps(settings),
    }


@dataclass(frozen=True, eq=False)
class _SentTask:
    """A task and its frames."""

    task: Task
    frames: tuple[StoredFrame, ...]


def _tasks(batch: Batch, config: RcvConfig, rotation: BoxRotation, from_reviewed: bool) -> Iterator[_SentTask]:
    """Yields the tasks of a batch, made on demand."""
    project, number = batch.project, 0
    frames = batch.pending()
    while task_frames := tuple(islice(frames, TASK_FRAMES)):
        specs = tuple(
            FrameSpec(batch.spec(frame.recording_id), frame.key, seeds_of(project, frame) if from_reviewed else ())
            for frame in task_frames
        )
        yield _SentTask(Task(number, specs, config, rotation), task_frames)
        number += 1


def _run_tasks(engine: Engine, tasks: Iterator[_SentTask], batch: Batch, progress: Progress | None) -> None:
    """Sends tasks to an engine, and stores their answers in the order of the tasks."""
    in_flight: deque[_SentTask] = deque()
    answers: dict[int, tuple[FrameAnswer, ...]] = {}
    stored, are_all_sent = 0, False
    while in_flight or not are_all_sent:
        while not are_all_sent and len(in_flight) < engine.window:
            task = next(tasks, None)
            are_all_sent = task is None
            if task is not None:
                engine.submit(task.task)
                in_flight.append(task)
        if not in_flight:
            break
        answer = engine.wait(HEARTBEAT_S)
        if answer is not None:
            answers[answer.number] = answer.frames
        elif progress is not None:
            progress(stored, batch.frames)
        while in_flight and in_flight[0].task.number in answers:
            oldest = in_flight.popleft()
            for frame, result in zip(oldest.frames, answers.pop(oldest.task.number), strict=True):
                batch.store(frame, result)
            stored += len(oldest.frames)
            if progress is not None:
                progress(stored, batch.frames)
