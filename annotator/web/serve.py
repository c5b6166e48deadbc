"""Runs the application: one server, one port."""

from __future__ import annotations

import secrets
import socket
import sys
import threading
import time
import webbrowser
from contextlib import closing, suppress
from dataclasses import replace

import uvicorn
from fastapi import FastAPI

from annotator.types.errors import ConfigError
from annotator.web.app import create_app
from annotator.web.security import is_loopback, link
from annotator.web.settings import ServerSettings
from annotator.web.sole import sole_server
from annotator.web.window import check_window, has_display, in_window

# The largest message that a browser sends, bytes.
WS_LIMIT = 1 << 22


class Running(uvicorn.Server):
    """A server on a socket that is bound already, so that its port is known before it begins."""

    def __init__(self, settings: ServerSettings, app: FastAPI | None = None) -> None:
        """
        Args:
            app: what is served; None = the workbench.

        Raises:
            ConfigError: the address cannot be used, or anybody could come in.
        """
        self.settings = settings
        self.app = create_app(settings) if app is None else app
        self.socket = bind(settings.host, settings.port)
        self.port: int = self.socket.getsockname()[1]
        super().__init__(
            uvicorn.Config(
                self.app,
                log_level="warning",
                timeout_graceful_shutdown=3,
                ws="websockets-sansio",
                ws_max_size=WS_LIMIT,
                # clouds go to a browser on this computer, or beside it: packing them costs more than it saves
                ws_per_message_deflate=False,
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
    # named as TCP: asyncio switches Nagle's delay off only there, and it costs every answer some 40 ms
    bound = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
        bound.listen(128)
    except (OSError, OverflowError) as error:
        bound.close()
        raise ConfigError(f"cannot listen on {host} port {port}: {error}; choose another with --port") from error
    return bound


def with_token(settings: ServerSettings) -> ServerSettings:
    """The settings, with a new token where another address than this computer's own has none."""
    if settings.token is None and not is_loopback(settings.host):
        return replace(settings, token=secrets.token_urlsafe(32))
    return settings


def serve(settings: ServerSettings, place: str | None = None, *, open_browser: bool, window: bool) -> None:
    """Serves until interrupted, or until the window is closed; says where on standard output.

    Another address than this computer's own gets a token where the settings have none.

    Args:
        place: where on the page to begin, such as `room/review`.

    Raises:
        ConfigError: the address cannot be used, another server works on these projects, or there is no display for a
            window.
        MissingExtraError: a window needs pywebview.
    """
    settings = with_token(settings)
    if window:
        check_window()
    with sole_server(settings.projects_root):
        server = Running(settings)
        address = link(server.address, settings.token, place)
        sys.stdout.write(f"the workbench is at {address}\n")
        if not window:
            sys.stdout.write("stop it with Ctrl-C\n")
        sys.stdout.flush()
        # the last Ctrl-C is how a server ends, and no accident
        with suppress(KeyboardInterrupt):
            if window:
                in_window(server, address)
                return
            if open_browser:
                threading.Thread(target=_open, args=(server, address), daemon=True).start()
            server.serve_until_stopped()


def _open(server: Running, address: str) -> None:
    while not server.started:
        time.sleep(0.05)
    if not has_display() or not webbrowser.open(address):
        sys.stdout.write("no browser could be opened here: open the link in one\n")
        sys.stdout.flush()
