"""A viser server that only the proxy can connect to."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from websockets.asyncio.server import ServerConnection
from websockets.protocol import State

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
# Connections of one viser server whose request has not come yet; the proxy needs few, and only for a moment.
MOST_SILENT = 32

_starting = threading.Lock()
_quiet = threading.Lock()


@contextmanager
def silence() -> Iterator[None]:
    """Suppresses viser's messages on the terminal, which it prints on start and stop even with `verbose=False`."""
    import rich

    with _quiet:
        console = rich.get_console()
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before


def start_viser(host: str, origin: str) -> viser.ViserServer:
    """A viser server on a free port of `host`, which refuses every WebSocket whose `Origin` is not `origin`.

    Any page in any browser on this computer may open a WebSocket to a port of 127.0.0.1, and viser accepts all of them.
    With a secret origin, which no browser sends, only the proxy can connect.

    Raises:
        RuntimeError: this version of viser cannot be restricted in this way.
    """
    import viser

    with _starting, _required_origin(origin) as guarded:
        server = viser.ViserServer(host, 0, verbose=False)
    if not guarded:
        server.stop()
        raise RuntimeError(
            "access to the 3D view cannot be restricted with this version of viser; install another version"
        )
    return server


class _FewSilent(ServerConnection):
    """A connection to viser. Other users of this computer can open some, too, but not take all file descriptors."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Accepts a connection; closes the oldest silent one if there are too many."""
        super().connection_made(transport)
        silent = [other for other in self.server.handlers if other.state is State.CONNECTING]
        if len(silent) > MOST_SILENT:
            silent[0].transport.abort()


@contextmanager
def _required_origin(origin: str) -> Iterator[list[str]]:
    """Patches `websockets.serve` to require `origin`, since viser has no option for it.

    The constructor of a viser server returns once it serves, so the patch is active only during the call. Yields the
    list of origins of the servers started so far.
    """
    from websockets.asyncio import server as sockets
    from websockets.typing import Origin

    serve, guarded = sockets.serve, list[str]()

    def guard(*arguments: Any, **options: Any) -> Any:
        guarded.append(origin)
        return serve(*arguments, **options, origins=[Origin(origin)], create_connection=_FewSilent)

    setattr(sockets, "serve", guard)  # noqa: B010  (mypy forbids a plain assignment)
    try:
        yield guarded
    finally:
        setattr(sockets, "serve", serve)  # noqa: B010
