"""`annotator serve`"""

from __future__ import annotations

import sys
from pathlib import Path

from annotator.cli import options
from annotator.cli.output import print_line
from annotator.detection.config import Backend
from annotator.project import Project
from annotator.types.errors import ConfigError
from annotator.types.messages import amount


def serve(
    project: str | None = None,
    /,
    *,
    folder: tuple[Path, ...] = (),
    host: options.Host = "127.0.0.1",
    port: options.Port = 8080,
    token_file: options.TokenFile = None,
    no_token: options.NoToken = False,
    open: bool = False,
    window: bool = False,
    projects: options.Projects = None,
) -> None:
    """Start the workbench, a web page to draw, review and export boxes.

    Args:
        project: name of the project to open; default: the start page.
        folder: folders from which the page may add recordings; it shows no other folder. With --host, recordings of the
            projects are only read there, too.
        open: open the page in the browser.
        window: open the page in a window of its own.
    """
    from annotator.web.security import ServerSettings, is_loopback, with_token
    from annotator.web.serve import serve

    root = options.projects_root(projects)
    missing = [str(path) for path in folder if not path.is_dir()]
    if missing:
        raise ConfigError(f"--folder {' '.join(missing)}: no such folder")
    if not folder and not is_loopback(host):
        print_line("with --host, recordings are read only in the folders of --folder, and none is given")
    settings = ServerSettings(root.resolve(), folder, host, port)
    settings = with_token(settings, token_file, no_token=no_token)
    serve(settings, None if project is None else first_page(project, root), open_browser=open, window=window)


def first_page(name: str, root: Path) -> str:
    """The page to open first, of a project that exists."""
    with options.open_named(name, root):
        return f"{name}/annotate"


def live(
    project: Project,
    source: str,
    /,
    *,
    backend: options.BackendOption[Backend] = "fastest",
    no_warm_start: bool = False,
    record: Path | None = None,
    host: options.Host = "127.0.0.1",
    port: options.Port = 8081,
    token_file: options.TokenFile = None,
    no_token: options.NoToken = False,
    limit: options.Limit = None,
    loop: bool = False,
    rate: float | None = None,
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
    from annotator.web.live import LiveOptions, run_live
    from annotator.web.security import ServerSettings, with_token
    from annotator.workflows.live.pipeline import summary_line

    chosen = LiveOptions(source, rate, loop, backend, not no_warm_start, limit, record)
    settings = ServerSettings(project.path.parent.resolve(), (), host, port)
    settings = with_token(settings, token_file, no_token=no_token)
    figures, stored = run_live(project, chosen, settings, report=_to_stderr)
    print_line(summary_line(figures))
    if record is not None:
        print_line(
            "no frame was recorded"
            if stored is None
            else f"recorded {record}: {amount(stored.frames, 'frame')}, {amount(stored.proposals, 'proposal')}; "
            f"in {project.path.name} as {stored.name}, ready for review"
        )


def _to_stderr(line: str) -> None:
    sys.stderr.write(line + "\n")
