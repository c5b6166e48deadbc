"""`annotator track`"""

from __future__ import annotations

from annotator.cli.output import print_line
from annotator.cli.progress import counted
from annotator.cli.projects import Root, open_named
from annotator.types.errors import ConfigError
from annotator.workflows.tracks.link import link_tracks


def run(
    project: str,
    /,
    *,
    recordings: tuple[str, ...] = (),
    smooth: bool = False,
    no_smooth: bool = False,
    root: Root = None,
) -> int:
    """Link the boxes of each object over a recording: give them track ids, and proposals a steady size and heading.

    Boxes that somebody has reviewed stay as they are, and so do track ids that somebody has given, and finalised
    frames. Run it again whenever there are new boxes; where nothing is new, nothing changes.

    Args:
        project: the project's name.
        recordings: names of the recordings to do; default: all.
        smooth: give open proposals the size and the smooth rotations of their track; this is the default.
        no_smooth: only link; open proposals get back the boxes that they were proposed with.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    if smooth and no_smooth:
        raise ConfigError("--smooth and --no-smooth say the opposite of each other; give one of them")
    with open_named(project, root) as opened:
        chosen = [opened.recordings.find(name).id for name in recordings] or None
        with counted("track") as progress:
            done = link_tracks(opened, recordings=chosen, smooth=not no_smooth, progress=progress)
    print_line(f"{done.boxes} boxes in {done.tracks} tracks of {done.recordings} recordings, {done.changed} changed")
    if done.left:
        print_line(f"left alone: {done.left} boxes without a track in finalised frames; reopen these to give them one")
    if done.unordered:
        print_line(f"left out: {', '.join(done.unordered)}, whose frames do not follow each other in time")
    if done.busy:
        print_line(f"not finished: {', '.join(done.busy)}, where somebody is at work; run this again")
    return 1 if done.busy else 0
