"""Runs the application on one port."""

from __future__ import annotations

import secrets
import socket
import sys
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace

import uvicorn
from fastapi import FastAPI

from annotator.types.errors import ConfigError
from annotator.web.app import create_app
from annotator.web.heaps import tidy_heaps
from annotator.web.security import is_loopback, link
from annotator.web.server_lock import hold_server_lock
from annotator.web.settings import ServerSettings
from annotator.web.window import check_window, has_display, in_window

# Maximum size of a WebSocket message from a browser, bytes.
WS_LIMIT = 1 << 22


class Running(uvicorn.Server):
    """A server on a bound socket, so that its port is known before it starts."""

    def __init__(self, settings: ServerSettings, app: FastAPI | None = None) -> None:
        """
        Args:
            app: the application to serve; None = the workbench.

        Raises:
            ConfigError: the address cannot be used, or would be open to the network without a token.
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
                # the browser is on this computer or near it: compressing clouds costs more than it saves
                ws_per_message_deflate=False,
                # forwarded headers of proxies are not trusted
                proxy_headers=False,
                server_header=False,
            )
        )

    @property
    def address(self) -> str:
        """The URL for a browser on this computer."""
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.settings.host, self.settings.host)
        return f"http://{host}:{self.port}/"

    def serve_until_stopped(self) -> None:
        """Serves until `should_exit` is set, or until interrupted."""
        with closing(self.socket), tidy_heaps():
            self.run(sockets=[self.socket])

    def stop(self) -> None:
        """Asks the server to stop."""
        self.should_exit = True


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        ConfigError: the address does not belong to this computer, or is in use.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # explicitly TCP: otherwise asyncio does not disable Nagle's algorithm, which delays every response by some 40 ms
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
    """Returns the settings, with a new token if the address is not loopback and has none."""
    if settings.token is None and not is_loopback(settings.host):
        return replace(settings, token=secrets.token_urlsafe(32))
    return settings


def serve(settings: ServerSettings, place: str | None = None, *, open_browser: bool, window: bool) -> None:
    """Serves until interrupted, or until the window is closed; prints the URL.

    An address that is not loopback gets a token if the settings have none.

    Args:
        place: initial place on the page, such as `room/review`.

    Raises:
        ConfigError: the address cannot be used, another server uses these projects, or there is no display for a
            window.
        MissingExtraError: a window needs pywebview.
    """
    settings = with_token(settings)
    if window:
        check_window()
    with hold_server_lock(settings.projects_root):
        server = Running(settings)
        address = link(server.address, settings.token, place)
        sys.stdout.write(f"the workbench is at {address}\n")
        if not window:
            sys.stdout.write("stop it with Ctrl-C\n")
        sys.stdout.flush()
        # Ctrl-C is the regular end of a server
        with suppress(KeyboardInterrupt):
            if window:
                in_window(server.serve_until_stopped, server.stop, address)
                return
            if open_browser:
                threading.Thread(target=_open, args=(server, address), daemon=True).start()
            server.serve_until_stopped()


@contextmanager
def serving(settings: ServerSettings, place: str | None = None) -> Iterator[None]:
    """Serves in another thread within the `with` block; prints the URL and opens a browser.

    Args:
        settings: of an address that needs no token.
        place: as for `serve`.

    Raises:
        ConfigError: as `serve`; or the server ends before it has started.
    """
    with hold_server_lock(settings.projects_root):
        server = Running(settings)
        address = link(server.address, settings.token, place)
        sys.stdout.write(f"the workbench is at {address}\n")
        sys.stdout.flush()
        thread = threading.Thread(target=server.serve_until_stopped)
        thread.start()
        try:
            _open(server, address, thread.is_alive)
            if not server.started:
                raise ConfigError("the workbench did not start; the messages above say why")
            yield
        finally:
            server.stop()
            thread.join()


def _open(server: Running, address: str, is_alive: Callable[[], bool] = lambda: True) -> None:
    """Opens a browser once the server has started; does nothing if it ends before."""
    while not server.started and is_alive():
        time.sleep(0.05)
    if not server.started:
        return
    if not has_display() or not webbrowser.open(address):
        sys.stdout.write("no browser could be opened; open the link in one yourself\n")
        sys.stdout.flush()
