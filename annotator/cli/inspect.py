"""`annotator inspect`"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from annotator.cli.options import AS_FILES_SAY, AsJson, Reading
from annotator.cli.output import facts, print_lines, print_result
from annotator.recordings.ros.topics import TopicReport
from annotator.types.errors import InputError, RecordingError, UnknownFormatError
from annotator.types.messages import amount
from annotator.workflows.inspect import FrameReport, RecordingReport, bag_topics, inspect_recording


def run(path: Path, /, *, reading: Reading = AS_FILES_SAY, as_json: AsJson = False) -> None:
    """Show what a recording contains: format, frames, camera, points, labels; of a bag, its topics.

    Args:
        path: file or folder of the recording.
    """
    options = reading.options()
    try:
        report = inspect_recording(path, options)
    except UnknownFormatError as error:
        if not as_json:
            print_lines(facts(line.partition(": ")[::2] for line in error.looked_for))
        raise
    except InputError:
        # the topics of a bag among which the error asks to choose
        if not as_json:
            print_lines(facts(_topic_rows(bag_topics(path))))
        raise
    print_result(report, facts(_rows(report)), as_json)
    if report.frame is None:
        raise RecordingError(f"{path}: none of its first frames can be read ({len(report.broken)} tried); see above")


def _rows(report: RecordingReport) -> Iterator[tuple[str, object]]:
    yield "recording", report.path
    yield "format", report.format
    order = "in time order" if report.is_sequence else "unrelated"
    yield "frames", f"{report.frames} ({report.first_key} to {report.last_key}), {order}"
    for note in report.notes:
        yield "note", note
    if report.origin is not None:
        yield "origin", f"{_metres(report.origin)} m in the map coordinates of the clouds (--origin sets another place)"
    if (poses := report.poses) is not None:
        yield "poses", poses.words()
        yield from (("poses", problem) for problem in (*poses.gaps, *poses.jumps))
    yield from _topic_rows(report.topics)
    for key, problem in report.broken.items():
        yield f"frame {key}", f"cannot be read: {problem}"
    if report.frame is not None:
        yield from _frame_rows(report.frame)


def _topic_rows(topics: Sequence[TopicReport]) -> Iterator[tuple[str, object]]:
    for topic in sorted(topics, key=lambda topic: not topic.use):
        rate = "" if topic.rate_hz is None else f", {topic.rate_hz:.3g} Hz"
        if topic.use or topic.option:
            yield (
                "topic",
                f"{topic.name} ({topic.type}, {amount(topic.messages, 'message')}{rate}): {topic.use or topic.option}",
            )
    others = Counter(topic.type for topic in topics if not (topic.use or topic.option))
    if others:
        types = ", ".join(f"{count} of {kind}" for kind, count in others.most_common())
        yield "topics", f"{amount(others.total(), 'other')} not used (--json lists all): {types}"


def _frame_rows(frame: FrameReport) -> Iterator[tuple[str, object]]:
    yield "first frame", frame.key
    yield (
        "image",
        f"{frame.camera.width_px} x {frame.camera.height_px} px"
        + (", with depth image" if frame.has_depth_image else ""),
    )
    camera = frame.camera
    yield "camera", f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g} px"
    if frame.place is not None:
        yield "camera at", f"{_metres(frame.place)} m in the world"
    yield "distortion", " ".join(f"{k:g}" for k in camera.distortion) if any(camera.distortion) else "none"
    extras = [name for name, known in (("colour", frame.has_colour), ("reflectance", frame.has_reflectance)) if known]
    yield "points", f"{frame.points} with {' and '.join(extras) or 'coordinates only'}"
    if frame.scanned is not None:
        yield "seen", f"the image shows {frame.seen:,} of {frame.scanned:,} points"
    yield "depth", f"{frame.nearest_m:.2f} to {frame.farthest_m:.2f} m"
    yield "up", " ".join(f"{x:g}" for x in frame.up) + " (camera frame)" if frame.up else "not known"
    if frame.timestamp_ns is not None:
        yield "time", f"{frame.timestamp_ns / 1e9:.3f} s"
    if frame.objects_problem is not None:
        yield "labels", f"cannot be read: {frame.objects_problem}"
    elif frame.objects is None:
        yield "labels", "none"
    else:
        yield "labels", ", ".join(f"{count} {name}" for name, count in frame.objects.items()) or "no objects"
    yield "mask", "yes" if frame.has_mask else "none"


def _metres(place: Sequence[float]) -> str:
    return " ".join(f"{value:.10g}" for value in place)
