"""What was seen, kept as a recording: written by a thread of its own, put in its place when it is complete.

Until then it grows in a hidden folder beside its place, which is a recording after every frame. What a killed process
has left there is put in order when somebody records to the same place again (`rescue`).
"""

from __future__ import annotations

import errno
import glob
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
from types import TracebackType
from typing import IO

from annotator.rcv.finish import FrameProposals
from annotator.recordings import Recording
from annotator.recordings.frame_writer import FrameWriter, trim
from annotator.types.errors import ConfigError, RecordingError
from annotator.workflows.live.detection import Detected

# Frames that wait for the disk at most; a frame is up to 10 MB.
MOST_WAITING = 16
LOCK = ".lock"

Tell = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Kept:
    """One frame of a finished recording: its key there, what was found, and how long that took."""

    key: str
    found: FrameProposals
    seconds: float


class Recorder:
    """Takes detected frames until `finish`; what was found is kept until it is closed.

    Attributes:
        out: where the recording will be.
        dropped: frames that the disk was too slow for.
    """

    def __init__(self, out: Path, tell: Tell = lambda line: None) -> None:
        """
        Args:
            out: a folder that is not there yet.
            tell: gets a line on what is found of earlier recordings that were cut off.

        Raises:
            ConfigError: something is at `out`, it cannot be made, or somebody records to it now.
        """
        self.out = out.resolve()
        self.dropped = 0
        if self.out.exists():
            raise ConfigError(f"{out}: exists already; record to another path, or remove it first")
        try:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            rescue(self.out, tell)
            self._part = Path(tempfile.mkdtemp(prefix=_prefix(self.out), dir=self.out.parent))
            self._held = _hold(self._part)
            # unbuffered: what does not fit is known at its own frame. Beside the recording: /tmp may be memory
            self._found = tempfile.TemporaryFile(buffering=0, dir=self.out.parent)  # noqa: SIM115 - closed by `close`
        except OSError as error:
            raise ConfigError(f"{out}: cannot be made ({error.strerror or error}); record to another path") from error
        self._writer = FrameWriter(self._part)
        self._kept = 0
        self._waiting: queue.Queue[Detected | None] = queue.Queue(MOST_WAITING)
        # the moments of a played recording are no times of day: all are told by one clock
        self._epoch_s = time.time() - time.perf_counter()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._write, name="record", daemon=True)
        self._thread.start()

    def put(self, detected: Detected) -> None:
        """One frame with its boxes; never waits.

        Raises:
            RecordingError: why nothing more can be written.
        """
        self.require_whole()
        try:
            self._waiting.put_nowait(detected)
        except queue.Full:
            self.dropped += 1

    def finish(self) -> int:
        """Waits until all is written, and puts the recording in its place; its frames. Without one there is none.

        Raises:
            RecordingError: it cannot be put there; the message says where it is.
        """
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        self._held.close()
        if not self._writer.frames:
            rmtree(self._part, ignore_errors=True)
            return 0
        try:
            trim(self._part)
            (self._part / LOCK).unlink(missing_ok=True)
            self._part.chmod(0o755)
            self._part.rename(self.out)
        except OSError as error:
            raise RecordingError(
                f"{self.out}: cannot be made ({error.strerror or error}); its {self._writer.frames} frames are in "
                f"{self._part}"
            ) from error
        return self._writer.frames

    def require_whole(self) -> None:
        """Tells of a finished recording that it has an end that nobody wanted, where `put` had no occasion to.

        Raises:
            RecordingError: why the last frames could not be written.
        """
        if self._error is not None:
            raise self._error

    def kept(self) -> Iterator[Kept]:
        """The frames of a finished recording with what was found on them, in order."""
        self._found.seek(0)
        for _ in range(self._kept):
            yield pickle.load(self._found)

    def close(self) -> None:
        """Forgets what was found."""
        self._found.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _write(self) -> None:
        while (detected := self._waiting.get()) is not None:
            if self._error is not None:
                continue  # whoever puts the next one is told; what waits must not hold up the end
            try:
                time_ns = round(1e9 * (self._epoch_s + detected.taken_s))
                key = self._writer.add(detected.frame, time_ns)
                self._keep(Kept(key, detected.found, detected.detect_s))
            except Exception as error:
                self._error = error

    def _keep(self, kept: Kept) -> None:
        """No list in memory: every proposal has its whole trace, and a recording may go on for hours."""
        data = pickle.dumps(kept)
        try:
            if self._found.write(data) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            raise RecordingError(
                f"{self.out}: what was found on frame {kept.key} cannot be written ({error.strerror or error}); "
                "make room, or record to another disk"
            ) from error
        self._kept += 1


def require_recordable(recording: Recording) -> None:
    """Refuses what could not be read back as it was seen.

    Raises:
        ConfigError: the frames do not follow each other in time, or have no pictures of their own.
    """
    if not recording.is_sequence:
        raise ConfigError(
            f"{recording.path}: its frames ({recording.format}) do not follow each other in time, each may be of "
            "another camera; leave --record away, and add the recording itself to the project"
        )
    if recording.format == "cloud_folder" and getattr(recording, "images", None) is None:
        raise ConfigError(
            f"{recording.path}: has no camera images, only pictures that are drawn from its points; leave --record "
            "away, and add the recording itself to the project"
        )


def rescue(out: Path, tell: Tell) -> None:
    """Puts in order what killed processes have left beside `out`: what has frames becomes a recording of its own.

    Raises:
        ConfigError: somebody records to `out` now.
        OSError: something there cannot be changed.
    """
    for part in sorted(out.parent.glob(f"{glob.escape(_prefix(out))}*")):
        try:
            held = _hold(part)
        except BlockingIOError as error:
            raise ConfigError(
                f"{out}: another `annotator live` records to it; end that one, or name another path"
            ) from error
        with held:
            frames = trim(part)
            (part / LOCK).unlink(missing_ok=True)
            if not frames:
                rmtree(part)
                tell(f"{part}: was left by a recording that had not begun; it is removed")
                continue
            place = _free(out)
            part.chmod(0o755)
            part.rename(place)
        tell(f"{place}: {frames} frames of a recording that was cut off; add them with `annotator add`")


def _prefix(out: Path) -> str:
    return f".{out.name}.recording-"


def _free(out: Path) -> Path:
    number = 1
    while (place := out.with_name(f"{out.name}-rescued-{number}")).exists():
        number += 1
    return place


def _hold(part: Path) -> IO[bytes]:
    """A file in a folder that is held until it is closed; a killed process gives it back.

    Raises:
        BlockingIOError: somebody holds it.
        OSError: the folder cannot be written.
    """
    file = (part / LOCK).open("wb")
    try:
        import fcntl
    except ImportError:  # not a POSIX system: nothing to hold it with
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise
    return file
