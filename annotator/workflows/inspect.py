"""A report on the content of a recording."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from annotator.geometry.projection import inside_image, project
from annotator.recordings import ReaderOptions, Recording, open_recording
from annotator.recordings.listing import path_errors
from annotator.recordings.look_around import Scanned
from annotator.recordings.poses import PosesReport, survey_poses
from annotator.recordings.ros.topics import TopicReport, list_topics
from annotator.types import Camera, Frame
from annotator.types.bases import Strict
from annotator.types.errors import FormatError, FrameError
from annotator.workflows.add_recordings import FRAMES_TRIED, NO_OPTIONS
from annotator.workflows.recorded.reading import has_truth, load_mask, load_truth


class FrameReport(Strict):
    """The content of one frame; lengths in metres, sizes in pixels.

    Attributes:
        scanned, seen: points of the LiDAR's whole scan, and how many of them the image shows; None without a LiDAR.
        place: where the camera stands in the world of the recording's map or poses; None without such.
    """

    key: str
    camera: Camera
    points: int
    scanned: int | None
    seen: int | None
    has_colour: bool
    has_reflectance: bool
    has_depth_image: bool
    nearest_m: float
    farthest_m: float
    up: tuple[float, float, float] | None
    place: tuple[float, float, float] | None
    timestamp_ns: int | None
    objects: dict[str, int] | None
    objects_problem: str | None
    has_mask: bool


class RecordingReport(Strict):
    """The content of a recording.

    Attributes:
        has_labels: it has true boxes.
        frame: the first readable frame.
        broken: the errors of the frames before it, by key.
        notes: what the reader says about it.
        poses: of its frames; None without poses.
        origin: of clouds in map coordinates without a camera (`clouds.virtual_camera`); None for others.
        topics: of a bag; empty for other formats.
    """

    path: Path
    format: str
    name: str
    frames: int
    first_key: str
    last_key: str
    is_sequence: bool
    has_labels: bool
    frame: FrameReport | None
    broken: dict[str, str]
    notes: tuple[str, ...]
    poses: PosesReport | None
    origin: tuple[float, float, float] | None
    topics: tuple[TopicReport, ...]


def inspect_recording(path: Path, options: ReaderOptions = NO_OPTIONS) -> RecordingReport:
    """Describes a recording by its list of frames and its first readable frame."""
    recording = open_recording(path, options)
    frame, report, broken = None, None, dict[str, str]()
    for index, key in enumerate(recording.keys[:FRAMES_TRIED]):
        try:
            frame = recording.frame(index)
            report = _report(recording, index, frame)
            break
        except FrameError as error:
            broken[key] = str(error)
    return RecordingReport(
        path=recording.path,
        format=recording.format,
        name=recording.name,
        frames=len(recording),
        first_key=recording.keys[0],
        last_key=recording.keys[-1],
        is_sequence=recording.is_sequence,
        has_labels=has_truth(recording),
        frame=report,
        broken=broken,
        notes=recording.notes,
        poses=survey_poses(recording),
        origin=None if frame is None or frame.T_world_camera is None else recording.origin,
        topics=bag_topics(path, options),
    )


def bag_topics(path: Path, options: ReaderOptions = NO_OPTIONS) -> tuple[TopicReport, ...]:
    """Returns the topics of a bag, for which they need not be chosen yet; none for other formats."""
    with path_errors(path):
        return list_topics(path, options) or ()


def _report(recording: Recording, index: int, frame: Frame) -> FrameReport:
    camera, cloud = frame.camera, frame.cloud
    objects, problem, has_mask = None, None, False
    try:
        if has_truth(recording):
            objects = Counter(truth.label for truth in load_truth(recording, index, frame))
        has_mask = load_mask(recording, frame) is not None
    except FormatError as error:
        problem = str(error)
    in_scan = len(recording.scan(index).read().xyz_m) if isinstance(recording, Scanned) else None
    return FrameReport(
        key=frame.key,
        camera=camera,
        points=len(cloud),
        scanned=in_scan,
        seen=None if in_scan is None else int(inside_image(camera, project(camera, cloud.xyz_m)).sum()),
        has_colour=cloud.rgb is not None,
        has_reflectance=cloud.reflectance is not None,
        has_depth_image=frame.depth_m is not None,
        nearest_m=float(cloud.xyz_m[:, 2].min()),
        farthest_m=float(cloud.xyz_m[:, 2].max()),
        up=None if frame.up is None else tuple(frame.up.tolist()),
        place=None if frame.T_world_camera is None else tuple(frame.T_world_camera.translation.tolist()),
        timestamp_ns=frame.timestamp_ns,
        objects=objects,
        objects_problem=problem,
        has_mask=has_mask,
    )
