"""Runs the application on one port."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import uuid
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from html import escape
from importlib.util import find_spec
from typing import Literal

import uvicorn
from fastapi import FastAPI

from annotator.files import make_private
from annotator.types.errors import ConfigError, MissingExtraError
from annotator.web.app import create_app
from annotator.web.background import tidy_heaps
from annotator.web.folders import JOBS_FOLDER, hold_server_lock
from annotator.web.limits import Connections, LimitedConfig, limited_log, most_connections
from annotator.web.security import ServerSettings, link

SIZE = (1366, 768)
INSTEAD = "leave --window out, and open the link in a browser"


def has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def check_window() -> None:
    """Checks that a window can be shown, before the server starts."""
    try:
        import webview  # noqa: F401
    except ImportError as error:
        raise MissingExtraError("pywebview", "desktop") from error
    if not has_display():
        raise ConfigError(f"there is no display for a window; {INSTEAD}")


def _toolkit() -> Literal["qt"] | None:
    """Qt if PySide6 is installed; otherwise pywebview tries all toolkits and prints the missing ones."""
    return "qt" if sys.platform == "linux" and find_spec("PySide6") else None


def in_window(serve: Callable[[], None], stop: Callable[[], None], address: str) -> None:
    """Serves until the window is closed. Toolkits need the process's main thread, so the server gets another."""
    import webview

    thread = threading.Thread(target=serve, name="server")
    thread.start()
    try:
        webview.settings["ALLOW_DOWNLOADS"] = True
        webview.create_window("annotator", address, width=SIZE[0], height=SIZE[1])
        # not in private mode, so that the cookie with the operator's name is kept
        webview.start(private_mode=False, gui=_toolkit())
    except webview.WebViewException as error:
        raise ConfigError(f"no window can be shown: {error}; {INSTEAD}") from error
    finally:
        stop()
        thread.join()


# Maximum size of a WebSocket message from a browser, bytes.
WS_LIMIT = 1 << 22
# Connections that the system keeps for the server, and those that are accepted at once, before others are served.
WAITING, AT_ONCE = 1024, 32
# The page that leads a browser to the printed link: a link in the browser's command line would be seen by all users.
OPENING = (
    '<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0;url={link}"><title>annotator</title>'
)


class Running(uvicorn.Server):
    """A server on a bound socket, so that its port is known before it starts."""

    def __init__(self, settings: ServerSettings, app: FastAPI | None = None) -> None:
        self.settings = settings
        self.app = create_app(settings) if app is None else app
        self.socket = bind(settings.host, settings.port)
        self.port: int = self.socket.getsockname()[1]
        super().__init__(
            LimitedConfig(
                self.app,
                Connections(most_connections()),
                log_config=None,
                log_level="warning",
                backlog=AT_ONCE,
                timeout_graceful_shutdown=3,
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

    def link(self, place: str | None = None) -> str:
        """The URL that the server prints: with the token, and optionally a place of the page."""
        return link(self.address, self.settings.token, place)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Starts to accept connections."""
        await super().startup(sockets)
        self.socket.listen(WAITING)

    def serve_until_stopped(self) -> None:
        """Serves until `should_exit` is set, or until interrupted."""
        with closing(self.socket), tidy_heaps():
            self.run(sockets=[self.socket])

    def stop(self) -> None:
        self.should_exit = True


def bind(host: str, port: int) -> socket.socket:
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


@contextmanager
def _prepared(settings: ServerSettings, place: str | None) -> Iterator[tuple[Running, str]]:
    """A server that may use its projects, and its link, which is printed."""
    with hold_server_lock(settings.projects_root), limited_log(settings.projects_root / JOBS_FOLDER):
        server = Running(settings)
        address = server.link(place)
        sys.stdout.write(f"the workbench is at {address}\n")
        sys.stdout.flush()
        yield server, address


def serve(settings: ServerSettings, place: str | None = None, *, open_browser: bool, window: bool) -> None:
    """Serves until interrupted, or until the window is closed; prints the URL."""
    if window:
        check_window()
    # Ctrl-C is the regular end of a server
    with _prepared(settings, place) as (server, address), suppress(KeyboardInterrupt):
        if window:
            in_window(server.serve_until_stopped, server.stop, address)
            return
        sys.stdout.write("stop it with Ctrl-C\n")
        sys.stdout.flush()
        with ExitStack() as stack:
            if open_browser:
                page = stack.enter_context(_opening(settings, address))
                threading.Thread(target=_open, args=(server, page), daemon=True).start()
            server.serve_until_stopped()


@contextmanager
def serving(settings: ServerSettings, place: str | None = None) -> Iterator[None]:
    """Serves in another thread within the `with` block; prints the URL and opens a browser."""
    with _prepared(settings, place) as (server, address), _opening(settings, address) as page:
        thread = threading.Thread(target=server.serve_until_stopped)
        thread.start()
        try:
            _open(server, page, thread.is_alive)
            if not server.started:
                raise ConfigError("the workbench did not start; the messages above say why")
            yield
        finally:
            server.stop()
            thread.join()


@contextmanager
def _opening(settings: ServerSettings, address: str) -> Iterator[str | None]:
    """The URL of a file that leads to the link, and that only this user may read; it is removed at the end.

    None if it cannot be written.
    """
    if settings.token is None:
        yield address
        return
    folder = settings.projects_root / JOBS_FOLDER
    page = folder / f"open-{uuid.uuid4().hex}.html"
    try:
        # those of servers that were killed
        for old in folder.glob("open-*.html"):
            old.unlink()
        make_private(page)
        page.write_text(OPENING.format(link=escape(address)), encoding="utf-8")
        url: str | None = page.resolve().as_uri()
    except OSError:
        url = None
    try:
        yield url
    finally:
        with suppress(OSError):
            page.unlink()


def _open(server: Running, address: str | None, is_alive: Callable[[], bool] = lambda: True) -> None:
    """Opens a browser once the server has started; does nothing if it ends before."""
    while not server.started and is_alive():
        time.sleep(0.05)
    if not server.started:
        return
    if address is None or not has_display() or not webbrowser.open(address):
        sys.stdout.write("no browser could be opened; open the link in one yourself\n")
        sys.stdout.flush()
