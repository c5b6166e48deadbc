"""`annotator serve`"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.projects import open_named, projects_root
from annotator.types.errors import ConfigError


def run(
    project: str | None = None,
    /,
    *,
    projects: Annotated[Path | None, tyro.conf.arg(aliases=["--root"])] = None,
    folder: tuple[Path, ...] = (),
    host: str = "127.0.0.1",
    port: int = 8080,
    token: str | None = None,
    open: bool = False,
    window: bool = False,
) -> None:
    """Serve the workbench, where boxes are drawn, reviewed and exported in the browser.

    Args:
        project: the project to begin with; default: the start page.
        projects: folder of projects; default: ANNOTATOR_PROJECTS, else ./projects.
        folder: folders that recordings may be added from; nothing else on the disk is shown.
        host: address to listen on; any but this computer's own asks browsers for a token.
        port: to listen on; 0 = a free one.
        token: what browsers must show; default: none on this computer, a new one on another address.
        open: show the page in the browser.
        window: show the page in a window of its own.
    """
    from annotator.web.serve import serve
    from annotator.web.settings import ServerSettings

    root = projects_root(projects)
    missing = [str(path) for path in folder if not path.is_dir()]
    if missing:
        raise ConfigError(f"--folder {' '.join(missing)}: no such folder")
    settings = ServerSettings(root.resolve(), folder, host, port, token)
    serve(settings, None if project is None else first_page(project, root), open_browser=open, window=window)


def first_page(name: str, root: Path) -> str:
    """Where to begin with a project: at its proposals, or with drawing boxes where there are none.

    Raises:
        ConfigError, ProjectError: as `open_named`.
    """
    with open_named(name, root) as project:
        return f"{name}/review" if project.statistics().frames_with_proposals else f"{name}/label"
