"""`annotator track`"""

from __future__ import annotations

from annotator.cli.options import ProjectName, Projects, RecordingNames
from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import open_named
from annotator.types.messages import amount
from annotator.workflows.tracks.link import link_tracks


def run(
    project: ProjectName,
    /,
    *,
    recordings: RecordingNames = (),
    no_smooth: bool = False,
    projects: Projects = None,
) -> int:
    """Link the boxes of each object into tracks, and smooth the proposals along them.

    Open proposals get the size and the smoothed rotations of their track. Reviewed boxes, track ids set by an operator
    and finalised frames do not change. Run the command again whenever there are new boxes.

    Args:
        no_smooth: only link; open proposals return to their original boxes.
    """
    with open_named(project, projects) as opened:
        chosen = [opened.recordings.find(name).id for name in recordings] or None
        with counted("track") as progress:
            done = link_tracks(opened, recordings=chosen, smooth=not no_smooth, progress=progress)
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
