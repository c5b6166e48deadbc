"""What an Azure Kinect's recording says of itself beside its images: tags, and the attached calibration."""

from __future__ import annotations

from pathlib import Path

from annotator.types.errors import RecordingError

REMEDY = "copy the recording again from its source"


def tags_and_calibration(path: Path) -> tuple[dict[str, str], bytes]:
    """The recording's tags and its attached calibration.

    Raises:
        RecordingError: the file cannot be read, or has no such attachment.
    """
    import av

    try:
        with av.open(str(path), metadata_errors="replace") as container:
            tags = {name: value for name, value in container.metadata.items() if name.startswith("K4A_")}
            for stream in container.streams:
                is_named = "K4A_CALIBRATION_FILE" in stream.metadata or stream.metadata.get("filename") == (
                    "calibration.json"
                )
                if stream.type == "attachment" and is_named:
                    return tags, bytes(stream.data)
    except (av.FFmpegError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read as Matroska ({error}); {REMEDY}") from error
    raise RecordingError(f"{path}: has no calibration attached; record it with the Azure Kinect's own recorder")


def tagged_ns(tags: dict[str, str], name: str) -> int:
    """A tag's nanoseconds; 0 without it."""
    text = tags.get(name, "0")
    try:
        return int(text)
    except ValueError:
        # older recorders left it out, so that recordings must do without it anyway
        return 0
