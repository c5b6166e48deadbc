"""`annotator track`, `follow`, `tracks`: objects through a recording."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import ValidationError
from tyro.conf import arg

from annotator.cli.classes import ClassName
from annotator.cli.options import RecordingName, RecordingNames, ids_of
from annotator.cli.output import counted, print_line
from annotator.project import Project
from annotator.types import ReviewState
from annotator.types.errors import ConfigError
from annotator.types.label import AttributeValue
from annotator.types.messages import amount, first_problem
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks import operations
from annotator.workflows.tracks.follow_run import follow_recording
from annotator.workflows.tracks.link import link_tracks
from annotator.workflows.tracks.operations import apply
from annotator.workflows.tracks.refit_run import RefitRun, box_fitter
from annotator.workflows.tracks.still_objects import Move, StandStill, candidates, find_sightings
from annotator.workflows.workbench.frame_cache import OpenFrame
from annotator.workflows.workbench.loaded_detectors import ready_view, view_with_classes


def run_track(project: Project, /, *, recordings: RecordingNames = (), no_smooth: bool = False) -> int:
    """Link the boxes of each object into tracks, and smooth the proposals along them.

    Open proposals get the size and the smoothed rotations of their track. Reviewed boxes, track ids set by an operator
    and finalised frames do not change. Run the command again whenever there are new boxes.

    Args:
        no_smooth: only link; open proposals return to their original boxes.
    """
    with counted("track") as progress:
        done = link_tracks(project, recordings=ids_of(project, recordings), smooth=not no_smooth, progress=progress)
    tracks = f"{amount(done.tracks, 'track')} of {amount(done.recordings, 'recording')}"
    print_line(f"{amount(done.boxes, 'box')} in {tracks}, {done.changed} changed")
    if done.left:
        left = amount(done.left, "box")
        print_line(f"unchanged: {left} without a track in finalised frames; reopen the frames to link all boxes")
    if done.unordered:
        print_line(f"skipped: {', '.join(done.unordered)}, whose frames are not in time order")
    if done.busy:
        print_line(f"not finished: {', '.join(done.busy)}, edited at the same time; run this again")
    return 1 if done.busy else 0


FOLLOW_AUTHOR = "annotator follow"


def run_follow(
    project: Project,
    recording: RecordingName,
    /,
    *,
    tracks: tuple[int, ...] = (),
    direction: Literal["forward", "backward", "both"] = "forward",
) -> None:
    """Follow reviewed boxes through a recording; no detector is needed.

    An object is followed by its points, frame by frame, until too little of it is left in the box, it leaves the image,
    or the recording ends. Its boxes keep the reviewed size, unless the project's view detector knows its class and
    measures it. Between two reviewed boxes it is followed from both ends. If it gets to neither from the other one,
    frames in which the results differ are left out. A reviewed box of its class that it comes to gets its track, unless
    it has another one: there it stops. The new boxes are proposals, to be reviewed.

    Args:
        tracks: ids of the tracks to follow; default: all tracks with a reviewed box.
        direction: go on after a track's last reviewed box (forward), before its first (backward), or both.
    """
    with counted("follow") as progress:
        done = follow_recording(
            project,
            project.recordings.find(recording).id,
            view_with_classes(project),
            FOLLOW_AUTHOR,
            tracks=tracks or None,
            forward=direction != "backward",
            backward=direction != "forward",
            progress=progress,
        )
    for item in done.tracks:
        name = item.label if item.track_id is None else f"track {item.track_id} ({item.label})"
        doubtful = f", {amount(item.doubtful, 'doubtful frame')} left out" if item.doubtful else ""
        print_line(f"{name}: {amount(item.boxes, 'box')} proposed{doubtful}")
        for stop in item.stops:
            print_line(f"  stopped at frame {stop.key}: {stop.reason}")


OPERATION_AUTHOR = "annotator tracks"

TrackNumber = Annotated[int, arg(help="number of the track.")]


@dataclass(frozen=True)
class Span:
    """The frames of an operation."""

    first: Annotated[
        str | None,
        arg(name="from", help="name of the first frame; default: the track's first.", help_behavior_hint=""),
    ] = None
    last: Annotated[
        str | None, arg(name="to", help="name of the last frame; default: the track's last.", help_behavior_hint="")
    ] = None
    dry_run: Annotated[bool, arg(help="only say what it would do.", help_behavior_hint="")] = False


InSpan = Annotated[Span, arg(name="")]
WHOLE = Span()


def set_class(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    label: ClassName,
    /,
    *,
    span: InSpan = WHOLE,
) -> None:
    """Give all boxes of a track a class."""
    _operate(project, recording, track, operations.SetClass, span, label=label)


def set_number(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    /,
    *,
    into: int | None = None,
    span: InSpan = WHOLE,
) -> None:
    """Give boxes of a track another number: split it with --from, or merge it into another track with --into.

    In a frame where both tracks have a box, the reviewed one stays, or else that of this track.

    Args:
        into: the number, also of a track with boxes; default: a new one.
    """
    _operate(project, recording, track, operations.SetNumber, span, number=into)


def set_size(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    size: Annotated[
        tuple[()] | tuple[float, float, float],
        arg(metavar="L W H", help="length, width and height, metres; default: what fits all its boxes and points."),
    ] = (),
    /,
    *,
    span: InSpan = WHOLE,
) -> None:
    """Give all boxes of a track one size, as a rigid object has it.

    Without a size, it is fitted to the reviewed boxes together, or to all if none is reviewed, and to the points of
    their frames. Each box keeps its rotation, its bottom, and the sides that face the camera, on which its points lie.
    """
    _operate(project, recording, track, operations.SetSize, span, size_m=size or None)


def set_values(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    values: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE", help="attributes; NAME= removes the value.")],
    /,
    *,
    span: InSpan = WHOLE,
) -> None:
    """Set values of attributes of all boxes of a track."""
    attributes = {each.name: each for each in project.config.attributes}

    def read(text: str) -> tuple[str, AttributeValue | None]:
        name, is_given, value = text.partition("=")
        if not is_given:
            raise ConfigError(f"{text!r} is no NAME=VALUE")
        if name not in attributes or not value:
            return name, None
        try:
            return name, attributes[name].read(value)
        except ValueError as error:
            raise ConfigError(str(error)) from error

    _operate(project, recording, track, operations.SetValues, span, values=dict(map(read, values)))


def delete(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    /,
    *,
    span: InSpan = WHOLE,
) -> None:
    """Remove the boxes of a track, reviewed ones too."""
    _operate(project, recording, track, operations.Delete, span)


def fill(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    /,
    *,
    refit: bool = False,
    span: InSpan = WHOLE,
) -> None:
    """Propose a box in each frame that has none between two boxes of a track.

    Centre, size and rotation are interpolated.

    Args:
        refit: fit every new box to the points of its frame, with the pseudo-view detector if it is trained.
    """
    # a detector that is broken is told before anything is stored
    view = ready_view(project) if refit and not span.dry_run else None
    done = _operate(project, recording, track, operations.Fill, span, refit=refit)
    if refit and not span.dry_run:
        source = FrameSource(project)
        fit = box_fitter(project, lambda frame: OpenFrame(source.read(frame)), view)
        with counted("fit") as progress:
            fitted = RefitRun(project, done, OPERATION_AUTHOR, fit).run(lambda now: progress(now.done, now.total))
        (item,) = fitted.tracks
        print_line(f"track {track}: fits {amount(item.boxes, 'box')} to the points")
        for stop in item.stops:
            print_line(f"  not in frame {stop.key}: {stop.reason}")


FrameName = Annotated[str | None, arg(help="name of a frame of the recording.", help_behavior_hint="")]


def still(
    project: Project,
    recording: RecordingName,
    tracks: Annotated[
        tuple[int, ...], arg(help="numbers of tracks; without any, those that may stand still are named.")
    ] = (),
    /,
    *,
    frame: FrameName = None,
    dry_run: bool = False,
) -> None:
    """Say that tracks stand still: each has one box in the world, which every frame that sees it shows, as reviewed.

    The recording must say where its camera was. In other frames, proposals of the track go, and reviewed boxes that
    agree with this one; others stay as exceptions. Then all frames are looked through for the objects. Run the command
    again after corrections, and for new frames.

    Args:
        frame: whose box of the track it is; default: the first reviewed one.
        dry_run: only say what it would do.
    """
    chosen = project.recordings.find(recording).id
    at = None if frame is None else project.frames.find(chosen, frame).id
    for track in tracks:
        _apply(project, chosen, track, StandStill(frame=at), dry_run)
    for track, why in () if tracks else candidates(project, chosen).items():
        print_line(f"track {track} may stand still: {why}")
    if dry_run:
        return
    with counted("look") as progress:
        looked = find_sightings(project, chosen, near=at, progress=progress)
    seen = Counter(each.label.track_id for each in project.labels.along(chosen) if each.still is not None)
    for one in (each for each in project.stills.of(chosen) if each.state is not ReviewState.REJECTED):
        stands = "is proposed to stand" if one.state is ReviewState.PROPOSED else "stands"
        print_line(f"track {one.track_id} ({one.label}) {stands} still, seen in {amount(seen[one.track_id], 'frame')}")
    print_line(f"looked through {amount(looked, 'frame')}")


def moving(
    project: Project,
    recording: RecordingName,
    track: TrackNumber,
    /,
    *,
    frame: FrameName = None,
    dry_run: bool = False,
) -> None:
    """Say that a track moves: its one box in the world becomes a box of each frame that sees it.

    Args:
        frame: in which the box stays reviewed; default: the first. In the others it is a proposal.
        dry_run: only say what it would do.
    """
    chosen = project.recordings.find(recording).id
    at = None if frame is None else project.frames.find(chosen, frame).id
    _apply(project, chosen, track, Move(frame=at), dry_run)


def _operate(
    project: Project,
    recording: str,
    track: int,
    kind: type[operations.Operation],
    span: Span,
    **given: Any,
) -> operations.Done:
    chosen = project.recordings.find(recording).id
    ends = {"first": span.first, "last": span.last}
    ids = {name: project.frames.find(chosen, key).id for name, key in ends.items() if key is not None}
    try:
        operation = kind.model_validate(given | ids)
    except ValidationError as error:
        raise ConfigError(first_problem(error)) from error
    return _apply(project, chosen, track, operation, span.dry_run)


def _apply(
    project: Project, recording_id: int, track: int, operation: operations.Operation, dry_run: bool
) -> operations.Done:
    done = apply(project, recording_id, track, operation, OPERATION_AUTHOR, dry_run=dry_run)
    print_line(f"track {track}: {done.count.words()}{' (nothing was stored)' if dry_run else ''}")
    return done
