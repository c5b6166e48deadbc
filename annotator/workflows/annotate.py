"""Proposals for whole recordings: a batch that goes on after a bad frame, and starts where it was stopped."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from annotator.project.config import BoxRotation
from annotator.project.frames import StoredFrame
from annotator.project.project import Project
from annotator.project.proposals import RunShare
from annotator.project.writing import Change
from annotator.rcv.config import REVISION, Orientation, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.rcv.propose import propose
from annotator.types import Frame, Source
from annotator.types.errors import AnnotatorError, ConfigError, FinalisedFrameError, StaleRevisionError
from annotator.workflows.detectors import Detectors
from annotator.workflows.frames import FrameSource, orientation_for

AUTHOR = "rcv"
# Frames that advance through the recursion together: enough for full detector batches, few enough for the memory.
BATCH_FRAMES = 4
# How often a write is tried anew because somebody else has changed the frame meanwhile.
WRITE_ATTEMPTS = 5


@dataclass
class AnnotateSummary:
    """What a batch did.

    Attributes:
        frames: that were to be done.
        skipped: done before with the same detectors and settings, or finalised.
        done: frames whose proposals are stored.
        proposals: found in all.
        without: frames done that gave no proposal.
        failed: key and reason of each frame that could not be done.
        seconds: in all.
    """

    frames: int = 0
    skipped: int = 0
    done: int = 0
    proposals: int = 0
    without: int = 0
    failed: list[tuple[str, str]] = field(default_factory=list)
    seconds: float = 0.0


def annotate(
    project: Project,
    detectors: Detectors,
    config: RcvConfig,
    *,
    recordings: Sequence[int] | None = None,
    rotation: BoxRotation | None = None,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> AnnotateSummary:
    """Proposes boxes for every frame that these detectors and settings have not done yet.

    A frame that cannot be read, or whose recursion fails, is stored with its reason, and the batch goes on. What is
    stored is stored: a killed batch goes on where it was.

    Args:
        config: its orientation is set frame by frame from `rotation`.
        recordings: ids; None = all.
        rotation: None takes the project's setting.
        limit: at most so many frames.
        progress: called with (frames done, frames to do).

    Raises:
        ConfigError: a limit below 1.
        ProjectError: the store refuses even to note that a frame failed.
    """
    if limit is not None and limit < 1:
        raise ConfigError(f"a limit of {limit} frames leaves nothing to do; give 1 or more")
    begin = time.perf_counter()
    rotation = rotation or project.config.settings.rotation
    settings = json.dumps(
        {**config.model_dump(mode="json", exclude={"orientation"}), "rotation": rotation.value, "method": REVISION}
    )
    run = project.jobs.start(
        image_detector=detectors.image.fingerprint, view_detector=detectors.view.fingerprint, config_json=settings
    )
    pending = project.jobs.pending(run.key, recordings)
    present = sum(frame.index is not None for frame in project.frames.of(recordings))
    summary = AnnotateSummary(skipped=present - len(pending))
    pending = pending[:limit]
    summary.frames = len(pending)
    batch = _Batch(project, detectors, config, rotation, run.id, summary)
    for first in range(0, len(pending), BATCH_FRAMES):
        batch.do(pending[first : first + BATCH_FRAMES])
        if progress is not None:
            progress(min(first + BATCH_FRAMES, len(pending)), len(pending))
    project.jobs.finish(run.id)
    summary.seconds = time.perf_counter() - begin
    return summary


@dataclass(frozen=True, eq=False)
class _Batch:
    project: Project
    detectors: Detectors
    config: RcvConfig
    rotation: BoxRotation
    run_id: int
    summary: AnnotateSummary
    source: FrameSource = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", FrameSource(self.project))

    def do(self, frames: Sequence[StoredFrame]) -> None:
        read: list[tuple[StoredFrame, Frame]] = []
        for stored in frames:
            begin = time.perf_counter()
            try:
                read.append((stored, self.source.read(stored)))
            except Exception as error:
                self._fail(stored, error, time.perf_counter() - begin)
        for orientation in Orientation:
            same = [pair for pair in read if orientation_for(self.rotation, pair[1]) is orientation]
            if same:
                self._propose(same, self.config.model_copy(update={"orientation": orientation}))

    def _propose(self, frames: Sequence[tuple[StoredFrame, Frame]], config: RcvConfig) -> None:
        begin = time.perf_counter()
        try:
            results = propose([frame for _, frame in frames], self.detectors.image, self.detectors.view, config)
        except Exception as error:
            if len(frames) == 1:
                self._fail(frames[0][0], error, time.perf_counter() - begin)
            else:  # find out whose fault it is
                for pair in frames:
                    self._propose([pair], config)
            return
        seconds = (time.perf_counter() - begin) / len(frames)
        for (stored, _), result in zip(frames, results, strict=True):
            self._store(stored, result, seconds)

    def _store(self, stored: StoredFrame, result: FrameProposals, seconds: float) -> None:
        share = RunShare(self.run_id, seconds)
        try:
            self._replace(stored.id, result, share)
        except FinalisedFrameError:  # since the batch began
            self.summary.skipped += 1
            self.summary.frames -= 1
            return
        except Exception as error:
            self._fail(stored, error, seconds)
            return
        self.summary.done += 1
        self.summary.proposals += len(result.proposals)
        self.summary.without += not result.proposals

    def _replace(self, frame_id: int, result: FrameProposals, share: RunShare) -> None:
        for attempt in range(1, WRITE_ATTEMPTS + 1):
            change = Change(self.project.frames.get(frame_id).revision, AUTHOR, Source.AUTO)
            try:
                self.project.proposals.replace(frame_id, result.proposals, change, lost=result.lost, run=share)
                return
            except StaleRevisionError:
                # An operator was faster. Proposals replace only what nobody has reviewed: the new state is as good.
                if attempt == WRITE_ATTEMPTS:
                    raise

    def _fail(self, stored: StoredFrame, error: Exception, seconds: float) -> None:
        """Stores the frame with its reason. A bug in one frame must not cost a night's batch either, so every
        exception ends here; one that is not meant for users brings the place where it happened along."""
        reason = str(error)
        if not isinstance(error, AnnotatorError):
            place = traceback.extract_tb(error.__traceback__)[-1]
            reason = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
        self.project.jobs.record_failure(self.run_id, stored.id, reason, seconds)
        self.summary.failed.append((stored.key, reason))
