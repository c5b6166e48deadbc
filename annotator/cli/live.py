"""`annotator live`"""

from __future__ import annotations

import sys
from pathlib import Path

from annotator.cli.options import BackendOption, Host, Limit, NoToken, Port, ProjectName, Projects, TokenFile
from annotator.cli.output import print_line
from annotator.cli.projects import open_named, projects_root
from annotator.detection.config import Backend
from annotator.types.messages import amount


def run(
    project: ProjectName,
    source: str,
    /,
    *,
    backend: BackendOption[Backend] = "fastest",
    no_warm_start: bool = False,
    record: Path | None = None,
    host: Host = "127.0.0.1",
    port: Port = 8081,
    token_file: TokenFile = None,
    no_token: NoToken = False,
    limit: Limit = None,
    loop: bool = False,
    rate: float | None = None,
    projects: Projects = None,
) -> None:
    """Detect on live frames and show them: point cloud with 3D boxes, camera image, frame rate, latency.

    Capture, detection and display run in parallel. Each takes the newest frame; frames that arrive too fast are
    dropped and counted. The command ends when the source ends, or with Ctrl-C.

    Args:
        source: path of a recording, or the name of one of the project, which plays at its own rate; or `kinect` for a
            connected Azure Kinect: `kinect:N` picks one of several by its serial number or by its index from 0.
        no_warm_start: do not start from the boxes of the previous frame; slower.
        record: write the frames to a new recording at this path, and add it to the project with its proposals.
        loop: restart the recording after its last frame.
        rate: play the recording at this rate, frames per second; default: its own rate.
    """
    from annotator.web.live.run import LiveOptions, run_live
    from annotator.web.settings import ServerSettings
    from annotator.web.tokens import with_token
    from annotator.workflows.live.rates import summary_line

    options = LiveOptions(source, rate, loop, backend, not no_warm_start, limit, record)
    settings = ServerSettings(projects_root(projects).resolve(), (), host, port)
    settings = with_token(settings, token_file, no_token=no_token)
    with open_named(project, projects) as opened:
        result = run_live(opened, options, settings, report=_to_stderr)
    print_line(summary_line(result.figures))
    if record is not None:
        stored = result.stored
        print_line(
            "no frame was recorded"
            if stored is None
            else f"recorded {record}: {amount(stored.frames, 'frame')}, {amount(stored.proposals, 'proposal')}; "
            f"in {project} as {stored.name}, ready for review"
        )


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
