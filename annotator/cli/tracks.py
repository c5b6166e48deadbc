"""`annotator track`, `follow`, `interpolate`: objects through a recording."""

from __future__ import annotations

from typing import Annotated, Literal

from tyro.conf import arg

from annotator.cli.options import RecordingName, RecordingNames, ids_of
from annotator.cli.output import counted, print_line
from annotator.project import Project
from annotator.types.messages import amount
from annotator.workflows.frame_source import FrameSource
from annotator.workflows.tracks.follow_run import follow_recording
from annotator.workflows.tracks.interpolate import box_fitter, interpolate
from annotator.workflows.tracks.link import link_tracks
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


INTERPOLATE_AUTHOR = "annotator interpolate"


def run_interpolate(
    project: Project,
    recording: RecordingName,
    /,
    *,
    track: int,
    first: Annotated[str | None, arg(name="from")] = None,
    last: Annotated[str | None, arg(name="to")] = None,
    refit: bool = False,
) -> None:
    """Propose the boxes of a track between its key frames, the frames with a reviewed box.

    Centre, size and rotation are interpolated from one key frame to the next. Reviewed boxes do not change; open
    proposals of the same object are replaced.

    Args:
        track: id of the track.
        first: name of the first key frame; default: the track's first one.
        last: name of the last key frame; default: the track's last one.
        refit: fit every new box to the points of its frame, with the pseudo-view detector if it is trained.
    """
    chosen = project.recordings.find(recording).id
    source, fit = FrameSource(project), None
    if refit:
        fit = box_fitter(project, lambda frame: OpenFrame(source.read(frame)), ready_view(project))
    done = interpolate(project, chosen, track, INTERPOLATE_AUTHOR, first=first, last=last, fit=fit)
    print_line(f"track {track}: {amount(len(done.filled), 'frame')} filled with proposals")
    if done.finalised or done.covered:
        finalised, covered = amount(done.finalised, "finalised frame"), amount(done.covered, "frame")
        print_line(f"unchanged: {finalised}, {covered} where the object is already labelled")
