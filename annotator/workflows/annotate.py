"""Proposals for whole recordings: a batch that goes on after a bad frame, and starts where it was stopped.

An engine does the work (`workflows/engines`); here frames are handed out, and what comes back is stored in their order.
No more tasks are out, or back and not stored, than the engine's window: a recording of any length needs as much memory.
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
from annotator.workflows.batch_book import AnnotateSummary, Batch
from annotator.workflows.detectors import Detectors
from annotator.workflows.engines.engine import Engine
from annotator.workflows.engines.exact import pickle_exactly
from annotator.workflows.engines.inline import InlineEngine
from annotator.workflows.engines.sources import GivenDetectors
from annotator.workflows.engines.tasks import FrameAnswer, FrameSpec, Identity, Task
from annotator.workflows.tracks.seeds import seeds_of

# Frames that advance through the recursion together: enough for full detector batches, few enough for the memory.
BATCH_FRAMES = 4
# Whoever watches the progress is told again after so long, so that a stop need not wait for a task's end.
HEARTBEAT_S = 0.5

Progress = Callable[[int, int], None]
"""Told (frames done, frames to do); what it raises ends the batch."""


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
    """`annotate_with` an engine that does everything in this process."""
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
    """Proposes boxes for every frame that has not been done with these detectors and settings yet.

    A frame that cannot be done is stored with its reason; the rest goes on, and the next call tries it again. Every
    frame is committed at once, so a call that is interrupted loses only what the engine holds.

    Args:
        engine: does the work; closed where something ends the batch early, and ready for more otherwise.
        config: the recursion's settings; `box_kind` is taken from it as it is, orientation is set frame by frame from
            `rotation`.
        recordings: ids; None = all.
        rotation: None takes the project's setting.
        limit: at most so many frames.
        from_reviewed: where the frame before was reviewed when this one's turn came, its boxes are what the recursion
            starts from. Part of the settings that decide whether a frame has been done.
        progress: told of frames that are stored, and again while nothing happens.

    Raises:
        ConfigError: a limit below 1.
        ProjectError: the store refuses even to note that a frame failed.
        WorkerError: the engine's workers cannot be kept alive.
    """
    require_limit(limit)
    begin = time.perf_counter()
    pickle_exactly()  # seeds
    rotation = rotation or project.config.settings.rotation
    try:
        identity = engine.start()
        run = project.jobs.start(**_described(identity, config, rotation, from_reviewed))
        present, pending = project.frames.count_present(recordings), project.jobs.count_pending(run.key, recordings)
        frames = pending if limit is None else min(pending, limit)
        summary = AnnotateSummary(frames=frames, skipped=present - pending, backends=identity.backends)
        batch = Batch(project, run, frames, recordings, summary)
        tasks = _tasks(batch, config, rotation, from_reviewed)
        _through(engine, tasks, batch, progress)
    except BaseException:
        engine.close()
        raise
    project.jobs.finish(run.id)
    batch.summary.seconds = time.perf_counter() - begin
    return batch.summary


def require_limit(limit: int | None) -> None:
    """Refuses a limit that leaves nothing to do.

    Raises:
        ConfigError: it is below 1.
    """
    if limit is not None and limit < 1:
        raise ConfigError(f"a limit of {limit} frames leaves nothing to do; give 1 or more")


def _described(identity: Identity, config: RcvConfig, rotation: BoxRotation, from_reviewed: bool) -> dict[str, str]:
    """A run's detectors and settings. Where the work is done is no part of them: it changes nothing."""
    settings = {
        **config.model_dump(mode="json", exclude={"orientation"}),
        "rotation": rotation.value,
        "method": REVISION,
        # absent where it is not asked for, so that frames that were done before there was this setting stay done
        **({"from_reviewed": True} if from_reviewed else {}),
    }
    return {
        "image_detector": identity.image,
        "view_detector": identity.view,
        "config_json": json.dumps(settings),
    }


@dataclass(frozen=True, eq=False)
class _Out:
    """A task that is out, and the frames that it is about."""

    task: Task
    frames: tuple[StoredFrame, ...]


def _tasks(batch: Batch, config: RcvConfig, rotation: BoxRotation, from_reviewed: bool) -> Iterator[_Out]:
    """The tasks of a batch, made as they are asked for."""
    project, number = batch.project, 0
    frames = batch.pending()
    while together := tuple(islice(frames, BATCH_FRAMES)):
        specs = tuple(
            FrameSpec(batch.spec(frame.recording_id), frame.key, seeds_of(project, frame) if from_reviewed else ())
            for frame in together
        )
        yield _Out(Task(number, specs, config, rotation), together)
        number += 1


def _through(engine: Engine, tasks: Iterator[_Out], batch: Batch, progress: Progress | None) -> None:
    """Sends tasks through an engine, and stores their answers in the order of the tasks."""
    out: deque[_Out] = deque()
    back: dict[int, tuple[FrameAnswer, ...]] = {}
    stored, is_over = 0, False
    while out or not is_over:
        while not is_over and len(out) < engine.window:
            task = next(tasks, None)
            is_over = task is None
            if task is not None:
                engine.submit(task.task)
                out.append(task)
        if not out:
            break
        answer = engine.wait(HEARTBEAT_S)
        if answer is not None:
            back[answer.number] = answer.frames
        elif progress is not None:
            progress(stored, batch.frames)
        while out and out[0].task.number in back:
            oldest = out.popleft()
            for frame, result in zip(oldest.frames, back.pop(oldest.task.number), strict=True):
                batch.store(frame, result)
            stored += len(oldest.frames)
            if progress is not None:
                progress(stored, batch.frames)
