"""Records live frames: a thread writes them, and the recording is moved to its path when it is complete.

Until then it is a hidden folder beside that path, which is a valid recording after every frame. The next recording to
the same path rescues the hidden folders of killed processes (`rescue`).
"""

from __future__ import annotations

import errno
import glob
import itertools
import json
import os
import pickle
import queue
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree

from annotator.files import lock_folder
from annotator.project import Project
from annotator.project.audit.writing import WriteContext
from annotator.project.config import BoxRotation
from annotator.project.proposals import RunShare
from annotator.rcv.config import REVISION, RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.recordings import Recording, open_recording
from annotator.recordings.frame_writer import FrameWriter, trim
from annotator.types import Source
from annotator.types.errors import ConfigError, RecordingError
from annotator.types.messages import amount
from annotator.workflows.add_recordings import register_recording
from annotator.workflows.detectors import Detectors
from annotator.workflows.live.detection import Detected

# Maximum number of frames that wait for the disk; a frame takes up to 10 MB.
MAX_WAITING = 16

Report = Callable[[str], None]


RecordedFrame = tuple[str, FrameProposals, float]
"""A frame of a finished recording: its key, its proposals, and the duration of the detection, seconds."""


class Recorder:
    """Records detected frames until `finish`; holds their proposals until `close`.

    Attributes:
        dropped: number of frames not recorded because the disk was too slow.
    """

    def __init__(self, out: Path, report: Report = lambda line: None) -> None:
        """
        Args:
            out: a folder that does not exist yet.
            report: called with a message for each interrupted recording that is rescued.
        """
        self.out = out.resolve()
        self.dropped = 0
        if self.out.exists():
            raise ConfigError(f"{out}: exists already; record to another path, or remove it first")
        try:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            rescue(self.out, report)
            self._part = Path(tempfile.mkdtemp(prefix=_prefix(self.out), dir=self.out.parent))
            self._lock = lock_folder(self._part)
            # unbuffered, so that an error names the frame that did not fit on the disk; beside the recording, since
            # /tmp may be in memory
            self._results = tempfile.TemporaryFile(buffering=0, dir=self.out.parent)  # noqa: SIM115 - closed by `close`
        except OSError as error:
            raise ConfigError(
                f"{out}: cannot be created ({error.strerror or error}); record to another path"
            ) from error
        self._writer = FrameWriter(self._part)
        self._result_count = 0
        self._waiting: queue.Queue[Detected | None] = queue.Queue(MAX_WAITING)
        # converts `perf_counter` times to wall-clock times, by one offset for the whole recording
        self._epoch_s = time.time() - time.perf_counter()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write, name="record", daemon=True)
        self._thread.start()

    def put(self, detected: Detected) -> None:
        """Adds a frame with its boxes, without waiting."""
        self.require_complete()
        try:
            self._waiting.put_nowait(detected)
        except queue.Full:
            self.dropped += 1

    def finish(self) -> int:
        """Waits until all frames are written, moves the recording to `out`, and returns the number of its frames.

        Creates no recording if there is no frame.
        """
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        self._lock.close()
        if not self._writer.frames:
            rmtree(self._part, ignore_errors=True)
            return 0
        try:
            trim(self._part)
            self._part.chmod(0o755)
            self._part.rename(self.out)
        except OSError as error:
            raise RecordingError(
                f"{self.out}: cannot be created ({error.strerror or error}); {amount(self._writer.frames, 'frame')} "
                f"kept in {self._part}"
            ) from error
        return self._writer.frames

    def require_complete(self) -> None:
        """Raises if the recording is incomplete."""
        if self._error is not None:
            raise self._error

    def recorded(self) -> Iterator[RecordedFrame]:
        """Yields the frames of a finished recording with their proposals, in order."""
        self._results.seek(0)
        for _ in range(self._result_count):
            yield pickle.load(self._results)

    def close(self) -> None:
        """Deletes the proposals."""
        self._lock.close()
        self._results.close()

    def _write(self) -> None:
        while (detected := self._waiting.get()) is not None:
            if self._error is not None:
                continue  # the next `put` raises the error; frames that wait are dropped, so that `finish` returns
            try:
                time_ns = round(1e9 * (self._epoch_s + detected.taken_s))
                key = self._writer.add(detected.frame, time_ns)
                self._store((key, detected.found, detected.detect_s))
            except Exception as error:
                self._error = error

    def _store(self, frame: RecordedFrame) -> None:
        """Writes proposals to a file: with their traces, those of a long recording would not fit in memory."""
        data = pickle.dumps(frame)
        try:
            if self._results.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise RecordingError(
                f"{self.out}: the proposals of frame {frame[0]} cannot be written ({error.strerror or error}); "
                "free some space, or record to another disk"
            ) from error
        self._result_count += 1


def require_recordable(recording: Recording) -> None:
    """Checks that a played recording can be recorded again without loss."""
    if not recording.is_sequence:
        raise ConfigError(
            f"{recording.path}: its frames ({recording.format}) do not follow each other in time, and may come from "
            "different cameras; omit --record, and add the recording itself to the project"
        )
    if recording.format == "cloud_folder" and getattr(recording, "images", None) is None:
        raise ConfigError(
            f"{recording.path}: has no camera images, only images drawn from its points; omit --record, and add the "
            "recording itself to the project"
        )


def rescue(out: Path, report: Report) -> None:
    """Turns the hidden folders of killed processes beside `out` into recordings; removes those without frames."""
    for part in sorted(out.parent.glob(f"{glob.escape(_prefix(out))}*")):
        try:
            lock = lock_folder(part, is_told=True)
        except BlockingIOError as error:
            raise ConfigError(
                f"{out}: another `annotator live` records to it; end that one, or record to another path"
            ) from error
        with lock:
            if frames := trim(part):
                free = (out.with_name(f"{out.name}-rescued-{n}") for n in itertools.count(1))
                rescued = next(path for path in free if not path.exists())
                part.chmod(0o755)
                part.rename(rescued)
                told = f"{rescued}: {amount(frames, 'frame')} of an interrupted recording; add it with `annotator add`"
            else:
                rmtree(part)
                told = f"{part}: removed; it is from an interrupted recording without frames"
        report(told)


def _prefix(out: Path) -> str:
    return f".{out.name}.recording-"


AUTHOR = "rcv, live"


@dataclass(frozen=True)
class Stored:
    """A stored session: the recording's name in the project, and the numbers of frames and proposals."""

    name: str
    frames: int
    proposals: int


def require_unused_path(project: Project, out: Path) -> None:
    """Checks that the project has no recording at `out`, not even one whose folder was removed.

    All live recordings use the same frame keys, so the labels of an old recording would be assigned to the new frames.
    """
    path = out.resolve()
    for known in project.recordings.all():
        if known.path == path:
            raise ConfigError(
                f"{out}: the project has a recording there already, {known.name}, whose labels would be assigned to "
                "the new frames; record to another path"
            )


def store(
    project: Project,
    recorder: Recorder,
    detectors: Detectors,
    config: RcvConfig,
    rotation: BoxRotation,
    *,
    warm_start: bool,
) -> Stored:
    """Adds a finished recording and its proposals to the project, ready for review.

    The stored settings differ from those of an `annotate` run, so `annotate` processes these frames again.
    """
    recording = open_recording(recorder.out)
    stored = register_recording(project, recording)
    settings = {
        **config.record(),
        "rotation": rotation.value,
        "method": REVISION,
        "live": "warm start" if warm_start else "each frame by itself",
        "backends": detectors.backends,
    }
    run = project.jobs.start(
        image_detector=detectors.image.fingerprint,
        view_detector=detectors.view.fingerprint,
        config_json=json.dumps(settings),
    )
    frames = {frame.key: frame for frame in project.frames.of([stored.id])}
    proposals = 0
    for key, result, seconds in recorder.recorded():
        frame, share = frames[key], RunShare(run.id, seconds)
        context = WriteContext(frame.revision, AUTHOR, Source.AUTO)
        project.proposals.replace(frame.id, result.proposals, context, run=share, box_kind=detectors.box_kind)
        proposals += len(result.proposals)
    project.jobs.finish(run.id)
    return Stored(stored.name, len(frames), proposals)
