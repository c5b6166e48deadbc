"""Runs the application: one server, one port."""

from __future__ import annotations

import socket
from contextlib import closing

import uvicorn

from annotator.types.errors import ConfigError
from annotator.web.app import create_app
from annotator.web.settings import ServerSettings

# The largest message that a browser sends, bytes.
WS_LIMIT = 1 << 22


class Running(uvicorn.Server):
    """A server on a socket that is bound already, so that its port is known before it begins."""

    def __init__(self, settings: ServerSettings) -> None:
        self.settings = settings
        self.app = create_app(settings)
        self.socket = bind(settings.host, settings.port)
        self.port: int = self.socket.getsockname()[1]
        super().__init__(
            uvicorn.Config(
                self.app,
                log_level="warning",
                timeout_graceful_shutdown=3,
                ws="websockets-sansio",
                ws_max_size=WS_LIMIT,
                # nobody in between is trusted to say who asks
                proxy_headers=False,
                server_header=False,
            )
        )

    @property
    def address(self) -> str:
        """What a browser on this computer opens."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.settings.host, self.settings.host)
        return f"http://{host}:{self.port}/"

    def serve_until_stopped(self) -> None:
        """Serves until it is told to stop (`should_exit`) or interrupted."""
        with closing(self.socket):
            self.run(sockets=[self.socket])


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        ConfigError: the address is no address of this computer, or somebody listens there already.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
        bound.listen(128)
    except (OSError, OverflowError) as error:
        bound.close()
        raise ConfigError(f"cannot listen on {host} port {port}: {error}; choose another with --port") from error
    return bound


def serve(settings: ServerSettings, project: str | None, *, open_browser: bool, window: bool) -> None:
    """Serves until interrupted, or until the window is closed.

    Raises:
        ConfigError: the address cannot be used.
    """
    server = Running(settings)
    server.serve_until_stopped()
