"""What a batch takes from the store, frame by frame, and brings back there, and the count of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from annotator.project.frames import StoredFrame
from annotator.project.jobs import Run
from annotator.project.project import Project
from annotator.project.proposals import RunShare
from annotator.project.writing import Change
from annotator.rcv.finish import FrameProposals
from annotator.types import Source
from annotator.types.errors import FinalisedFrameError, StaleRevisionError
from annotator.workflows.engines.runner import failure
from annotator.workflows.engines.tasks import FrameAnswer, RecordingSpec
from annotator.workflows.tracks.seeds import followed_tracks

AUTHOR = "rcv"
# Frames that are asked of the store at once.
PAGE_FRAMES = 200
# How often a write is tried anew because somebody else has changed the frame meanwhile.
WRITE_ATTEMPTS = 5
# Failures that a summary names; the store has all of them.
MOST_NAMED = 1000


@dataclass
class AnnotateSummary:
    """What a batch did.

    Attributes:
        frames: that were to be done.
        skipped: done before with the same detectors and settings, or finalised.
        done: frames whose proposals are stored.
        proposals: found in all.
        without: frames done that gave no proposal.
        failed: key and reason of the first frames that could not be done.
        more_failed: how many further ones could not.
        seconds: in all.
        backends: what ran the image and the view detector, such as ("openvino", "openvino").
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

    @property
    def failures(self) -> int:
        """Frames that could not be done."""
        return len(self.failed) + self.more_failed


@dataclass(eq=False)
class Batch:
    """What a batch takes from the store, and brings there.

    Attributes:
        frames: so many are to be done.
    """

    project: Project
    run: Run
    frames: int
    recordings: Sequence[int] | None
    summary: AnnotateSummary
    specs: dict[int, RecordingSpec] = field(default_factory=dict)

    def pending(self) -> Iterator[StoredFrame]:
        """The frames to be done, page by page; those that were finalised since they were counted are skipped."""
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
        """Where a recording is."""
        if recording_id not in self.specs:
            stored = self.project.recordings.get(recording_id)
            self.specs[recording_id] = RecordingSpec(stored.path, stored.name, self.project.path.name, stored.up)
        return self.specs[recording_id]

    def store(self, frame: StoredFrame, answer: FrameAnswer) -> None:
        """Stores what came of a frame."""
        if answer.result is None:
            self._fail(frame, answer)
            return
        try:
            self._replace(frame.id, answer.result, RunShare(self.run.id, answer.seconds))
        except FinalisedFrameError:  # since the batch began
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
            frame, found = self.project.frames.get(frame_id), result.proposals
            change = Change(frame.revision, AUTHOR, Source.AUTO)
            tracks = followed_tracks(self.project, frame, found)
            try:
                self.project.proposals.replace(frame_id, found, change, lost=result.lost, run=share, track_ids=tracks)
                return
            except StaleRevisionError:
                # An operator was faster. Proposals replace only what nobody has reviewed: the new state is as good.
                if attempt == WRITE_ATTEMPTS:
                    raise

    def _fail(self, frame: StoredFrame, answer: FrameAnswer) -> None:
        reason = answer.reason or "no reason is known"
        self.project.jobs.record_failure(self.run.id, frame.id, reason, answer.seconds)
        if len(self.summary.failed) < MOST_NAMED:
            self.summary.failed.append((frame.key, reason))
        else:
            self.summary.more_failed += 1
