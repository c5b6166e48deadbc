"""Reads the tags and the attached calibration of an Azure Kinect recording."""

from __future__ import annotations

from pathlib import Path

from annotator.files import check_file
from annotator.recordings.kinect.matroska import MOST_NS
from annotator.types.errors import RecordingError

REMEDY = "copy the recording again from its source"


def tags_and_calibration(path: Path) -> tuple[dict[str, str], bytes]:
    """Returns the recording's tags and its attached calibration.

    Raises:
        RecordingError: the file cannot be read, or has no calibration attached.
    """
    import av

    try:
        check_file(path)
        with av.open(str(path), metadata_errors="replace") as container:
            tags = {name: value for name, value in container.metadata.items() if name.startswith("K4A_")}
            for stream in container.streams:
                is_named = "K4A_CALIBRATION_FILE" in stream.metadata or stream.metadata.get("filename") == (
                    "calibration.json"
                )
                if stream.type == "attachment" and is_named:
                    return tags, bytes(stream.data)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise RecordingError(f"{path}: cannot be read as Matroska ({error}); {REMEDY}") from error
    raise RecordingError(f"{path}: has no calibration attached; record it with the Azure Kinect SDK's recorder")


def tagged_ns(tags: dict[str, str], name: str) -> int:
    """Returns a tag's nanoseconds; 0 if the tag is missing or damaged."""
    text = tags.get(name, "0")
    try:
        time_ns = int(text)
    except ValueError:
        # treated as missing: older recorders do not write these tags either
        return 0
    return time_ns if abs(time_ns) <= MOST_NS else 0
