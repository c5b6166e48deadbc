"""`annotator serve`"""

from __future__ import annotations

from pathlib import Path

from annotator.cli.options import Host, NoToken, Port, Projects, TokenFile, open_named, projects_root
from annotator.cli.output import print_line
from annotator.types.errors import ConfigError


def run(
    project: str | None = None,
    /,
    *,
    folder: tuple[Path, ...] = (),
    host: Host = "127.0.0.1",
    port: Port = 8080,
    token_file: TokenFile = None,
    no_token: NoToken = False,
    open: bool = False,
    window: bool = False,
    projects: Projects = None,
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

    root = projects_root(projects)
    missing = [str(path) for path in folder if not path.is_dir()]
    if missing:
        raise ConfigError(f"--folder {' '.join(missing)}: no such folder")
    if not folder and not is_loopback(host):
        print_line("with --host, recordings are read only in the folders of --folder, and none is given")
    settings = ServerSettings(root.resolve(), folder, host, port)
    settings = with_token(settings, token_file, no_token=no_token)
    serve(settings, None if project is None else first_page(project, root), open_browser=open, window=window)


def first_page(name: str, root: Path) -> str:
    """The page to open first: review if the project has proposals, else label.

    Raises:
        ConfigError, ProjectError: as `open_named`.
    """
    with open_named(name, root) as project:
        return f"{name}/review" if project.statistics().frames_with_proposals else f"{name}/label"
