"""What a server is told when it starts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class ServerSettings:
    """How one server works.

    Attributes:
        projects_root: the folder of projects.
        folders: folders that recordings may be picked from; nothing else on the disk is shown or read by path.
        host: address to listen on.
        port: to listen on; 0 = a free one.
        token: what a browser must show before it gets anything; None only on a loopback address.
    """

    projects_root: Path
    folders: tuple[Path, ...] = ()
    host: str = "127.0.0.1"
    port: int = 8080
    token: str | None = None
