"""Reads the frames of a batch from the store, stores their results, and counts them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from annotator.project.frames import StoredFrame
from annotator.project.jobs import Run
from annotator.project.project import Project
from annotator.project.proposals import RunShare
from annotator.project.writing import WriteContext
from annotator.rcv.finish import FrameProposals
from annotator.types import BoxKind, Source
from annotator.types.errors import FinalisedFrameError, ProjectError, StaleRevisionError
from annotator.workflows.frame_source import Rigs
from annotator.workflows.proposing.engines.runner import failure
from annotator.workflows.proposing.engines.tasks import FrameAnswer, RecordingSpec
from annotator.workflows.tracks.previous_boxes import followed_tracks

AUTHOR = "rcv"
# Frames per query of the store.
PAGE_FRAMES = 200
# Attempts to write a frame that is changed concurrently.
WRITE_ATTEMPTS = 5
# Maximum number of failures listed in a summary; the store has all of them.
MAX_LISTED = 1000


@dataclass
class AnnotateSummary:
    """Counts of a batch.

    Attributes:
        frames: frames to do.
        skipped: frames left out: done before with the same detectors and settings, or finalised.
        done: frames whose proposals are stored.
        proposals: number of all proposals.
        without: processed frames without proposals.
        failed: key and reason of the first failed frames.
        more_failed: number of further failed frames.
        seconds: duration of the batch.
        backends: of the image and the view detector, e.g. ("openvino", "openvino").
        learned: messages on up directions that reviewed boxes gave (`learn_up`).
    """

    frames: int = 0
    skipped: int = 0
    done: int = 0
    proposals: int = 0
    without: int = 0
    failed: list[tuple[str, str]] = field(default_factory=list)
    more_failed: int = 0
    seconds: float = 0.0
    backends: tuple[str, ...] = ()
    learned: tuple[str, ...] = ()

    @property
    def failures(self) -> int:
        """Number of failed frames."""
        return len(self.failed) + self.more_failed


@dataclass(eq=False)
class Batch:
    """A batch and its access to the store.

    Attributes:
        frames: number of frames to do.
        box_kind: what the proposed boxes enclose.
    """

    project: Project
    run: Run
    frames: int
    recordings: Sequence[int] | None
    summary: AnnotateSummary
    box_kind: BoxKind
    specs: dict[int, RecordingSpec] = field(default_factory=dict)

    @cached_property
    def rigs(self) -> Rigs:
        """The project's rigs."""
        return Rigs(self.project)

    def pending(self) -> Iterator[StoredFrame]:
        """Yields the frames to do, page by page; those finalised since they were counted are skipped."""
        last: StoredFrame | None = None
        left = self.frames
        while left > 0:
            limit = min(left, PAGE_FRAMES)
            page = self.project.jobs.pending(self.run.key, self.recordings, after=last, limit=limit)
            yield from page
            left -= len(page)
            if len(page) < limit:
                break
            last = page[-1]
        self.summary.frames -= left
        self.summary.skipped += left

    def spec(self, recording_id: int) -> RecordingSpec:
        """Returns a recording as a worker needs it."""
        if recording_id not in self.specs:
            stored = self.project.recordings.get(recording_id)
            self.project.recordings.require_readable(stored)
            self.specs[recording_id] = RecordingSpec(
                stored.path, stored.name, self.project.path.name, stored.up, stored.options, stored.correction
            )
        return self.specs[recording_id]

    def store(self, frame: StoredFrame, answer: FrameAnswer) -> None:
        """Stores the result or the failure of a frame."""
        if answer.result is None:
            self._fail(frame, answer)
            return
        try:
            self._replace(frame.id, answer.result, RunShare(self.run.id, answer.seconds))
        except FinalisedFrameError:  # finalised since the batch began
            self.summary.skipped += 1
            self.summary.frames -= 1
            return
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
            context = WriteContext(frame.revision, AUTHOR, Source.AUTO)
            tracks = followed_tracks(self.project, frame, proposals)
            try:
                self.project.proposals.replace(
                    frame_id,
                    proposals,
                    context,
                    lost=result.lost,
                    run=share,
                    track_ids=tracks,
                    box_kind=self.box_kind,
                    others=[other.label for other in self.rigs.others(frame)],
                )
                return
            except StaleRevisionError:
                # An operator has changed the frame. Proposals replace only unreviewed ones, so trying again is safe.
                if attempt == WRITE_ATTEMPTS:
                    raise

    def _require_unadjusted(self, recording_id: int) -> None:
        """Refuses results that were found before the recording's cloud was moved, or its up direction changed."""
        stored, used = self.project.recordings.get(recording_id), self.spec(recording_id)
        if (stored.up, stored.correction) != (used.up, used.correction):
            raise ProjectError(
                f"the up direction or the calibration of {stored.name} was changed during the run; annotate it again"
            )

    def _fail(self, frame: StoredFrame, answer: FrameAnswer) -> None:
        reason = answer.reason or "unknown reason"
        self.project.jobs.record_failure(self.run.id, frame.id, reason, answer.seconds)
        if len(self.summary.failed) < MAX_LISTED:
            self.summary.failed.append((frame.key, reason))
        else:
            self.summary.more_failed += 1
