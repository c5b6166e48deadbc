"""`annotator live`"""

from __future__ import annotations

import sys
from pathlib import Path

from annotator.cli.output import print_line
from annotator.cli.projects import Root, open_named, projects_root
from annotator.detection.config import Backend


def run(
    project: str,
    source: str,
    /,
    *,
    backend: Backend = "fastest",
    warm_start: bool = True,
    record: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8081,
    token: str | None = None,
    frames: int | None = None,
    loop: bool = False,
    rate: float | None = None,
    root: Root = None,
) -> None:
    """Detect on live frames and show them: the cloud with its boxes in 3D, the camera image, frames a second, latency.

    Capture, detection and display run side by side; each takes the newest frame, and frames that it has no time for
    are dropped and counted. It ends with the source, or with Ctrl-C.

    Args:
        project: whose detectors and settings are used.
        source: `kinect` for a connected Azure Kinect (`kinect:` and its serial number, or its place in the list from
            0), or a recording, which is played at its own rate.
        backend: what runs the detectors; fastest takes the fastest that is installed, in half precision where the
            processor has it; auto the fastest that gives what torch does.
        warm_start: begin with the boxes of the frame before, where they agree; faster.
        record: keep what was seen as a recording at this path, and add it to the project with its proposals.
        host: address to listen on; any but this computer's own asks browsers for a token.
        port: to listen on; 0 = a free one.
        token: what browsers must show; default: none on this computer, a new one on another address.
        frames: end after so many frames of the source.
        loop: begin the recording again after its last frame.
        rate: play a recording with so many frames a second instead.
        root: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
    """
    from annotator.web.live.run import LiveOptions, run_live
    from annotator.web.settings import ServerSettings
    from annotator.workflows.live.figures import told

    options = LiveOptions(source, rate, loop, backend, warm_start, frames, record)
    settings = ServerSettings(projects_root(root).resolve(), (), host, port, token)
    with open_named(project, root) as opened:
        result = run_live(opened, options, settings, tell=_tell)
    print_line(told(result.figures))
    if record is not None:
        kept = result.stored
        print_line(
            "no frame was recorded"
            if kept is None
            else f"recorded {record}: {kept.frames} frames, {kept.proposals} proposals; "
            f"in {project} as {kept.name}, ready for review"
        )


def _tell(line: str) -> None:
    sys.stderr.write(line + "\n")
