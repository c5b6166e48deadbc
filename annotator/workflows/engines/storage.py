"""Where workers find recordings: as the project has them, or elsewhere, on a shared folder or in a storage.

A worker on another machine may see `/data/room` of the driver as `/mnt/data/room`, or as an object storage's
`s3://bucket/room`. Storages are read through fsspec (`annotator.recordings.mirror`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from annotator.types.errors import ConfigError
from annotator.workflows.engines.scratch import scratch_folder
from annotator.workflows.engines.tasks import RecordingSpec
from annotator.workflows.frames import OpenedRecording, open_stored

CACHE_MB = 4000
# A recording that is open keeps the names of its frames, and its share of the cache; a project may have thousands.
MOST_OPEN = 2


@dataclass(frozen=True)
class Storage:
    """Where a worker reads recordings.

    Attributes:
        elsewhere: (folder as the project knows it, the same folder for workers: path or URL), the first match counts.
        cache_mb: so much of recordings in a storage a worker keeps on its disk.
    """

    elsewhere: tuple[tuple[Path, str], ...] = ()
    cache_mb: int = CACHE_MB

    def __post_init__(self) -> None:
        if self.cache_mb < 1:
            raise ConfigError(f"--cache-mb {self.cache_mb} is of no use; give 1 or more")

    def place(self, path: Path) -> str:
        """Where workers find what the project has at `path`."""
        for folder, other in self.elsewhere:
            if path.is_relative_to(folder):
                below = PurePosixPath(path.relative_to(folder))
                return other.rstrip("/") + (f"/{below}" if below.parts else "")
        return str(path)

    def open(self, recording: RecordingSpec) -> OpenedRecording:
        """A recording at its place.

        Raises:
            RecordingError: it is not there, or not readable.
            MissingExtraError: its storage needs a package that is not installed.
        """
        place = self.place(recording.path)
        if not is_url(place):
            return open_stored(Path(place), recording.name, recording.project, recording.up)
        from annotator.recordings.mirror import open_mirror

        mirror = open_mirror(place, scratch_folder() / "recordings", self.cache_mb * 10**6 // MOST_OPEN)
        return OpenedRecording(mirror, recording.up)


def is_url(place: str) -> bool:
    """Whether a place is in a storage, and not a path."""
    return "://" in place


def parse_elsewhere(words: Sequence[str]) -> tuple[tuple[Path, str], ...]:
    """FOLDER=PLACE, as it is typed.

    Raises:
        ConfigError: a word is none such.
    """
    found = []
    for word in words:
        folder, equals, other = word.partition("=")
        if not folder or not equals or not other:
            raise ConfigError(f"{word!r} names no place; write FOLDER=PLACE, such as /data=s3://bucket/data")
        found.append((Path(folder).resolve(), other))
    return tuple(found)
