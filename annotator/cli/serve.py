"""`annotator serve`"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from annotator.cli.projects import open_named, projects_root


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
    if project is not None:
        open_named(project, root).close()
    settings = ServerSettings(root, folder, host, port, token)
    serve(settings, project, open_browser=open, window=window)
