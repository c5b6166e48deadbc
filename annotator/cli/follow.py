"""`annotator follow`"""

from __future__ import annotations

from typing import Literal

from annotator.cli.options import ProjectName, Projects, RecordingName
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
from annotator.types.messages import amount
from annotator.workflows.tracks.follow_recording import follow_recording
from annotator.workflows.workbench.loaded_detectors import view_with_classes

AUTHOR = "annotator follow"


def run(
    project: ProjectName,
    recording: RecordingName,
    /,
    *,
    tracks: tuple[int, ...] = (),
    direction: Literal["forward", "backward", "both"] = "forward",
    projects: Projects = None,
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
    with open_named(project, projects) as opened, counted("follow") as progress:
        done = follow_recording(
            opened,
            opened.recordings.find(recording).id,
            view_with_classes(opened),
            AUTHOR,
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
