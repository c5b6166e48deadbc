"""A viser server that nobody but its own proxy can talk to."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"

_starting = threading.Lock()
_quiet = threading.Lock()


@contextmanager
def silence() -> Iterator[None]:
    """viser says on the terminal that it starts and stops, also where it is asked not to."""
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

    Any page in any browser on this computer may open a WebSocket to a port of 127.0.0.1, and viser takes all of them.
    An origin that is a secret, and that no browser would ever send, leaves the way through the proxy only.
    """
    import viser

    with _starting, _refusing_others(origin) as guarded:
        server = viser.ViserServer(host, 0, verbose=False)
    if not guarded:
        server.stop()
        raise RuntimeError("this viser serves its WebSockets in a way that annotator does not know how to guard")
    return server


@contextmanager
def _refusing_others(origin: str) -> Iterator[list[str]]:
    """viser hands no `origins` on to the library that serves its WebSockets: so it is put in where that is called.

    Constructing a viser server waits until it serves, thus this lasts no longer than the call, and touches no other.
    Gives the origins of the servers that were started, as they are.
    """
    from websockets.asyncio import server as sockets
    from websockets.typing import Origin

    serve, guarded = sockets.serve, list[str]()

    def guard(*arguments: Any, **options: Any) -> Any:
        guarded.append(origin)
        return serve(*arguments, **(options | {"origins": [Origin(origin)]}))

    setattr(sockets, "serve", guard)  # noqa: B010  (mypy lets no class be assigned to)
    try:
        yield guarded
    finally:
        setattr(sockets, "serve", serve)  # noqa: B010
