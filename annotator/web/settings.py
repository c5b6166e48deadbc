"""Settings of a server."""

from __future__ import annotations

import secrets
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class ServerSettings:
    """Settings of one server.

    Attributes:
        projects_root: the projects folder.
        folders: folders that recordings may be added from; browsers cannot list or read anything else.
        host: address to listen on.
        port: port to listen on; 0 = a free one.
        token: secret that a browser must present once, in the link that the server prints; None is permitted on
            loopback addresses only.
        cookie: secret that a browser gets for the token, and presents from then on.
    """

    projects_root: Path
    folders: tuple[Path, ...] = ()
    host: str = "127.0.0.1"
    port: int = 8080
    token: str | None = field(default=None, repr=False)
    cookie: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
