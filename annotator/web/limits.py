"""Limits that keep a server usable for those who have signed in, whatever others send."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager, suppress
from io import TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, Literal

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from annotator.files import make_private

# Number of keys that are remembered; the one that was not used for the longest time is forgotten first.
MOST_KEYS = 4096


class Rate:
    """At most `burst` events at once, and `per_s` a second in the long run, counted for each key."""

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, float(burst), clock
        # key -> how many more events are allowed, and at what time; the key used last is at the end
        self._left: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()

    def allows(self, key: Hashable) -> bool:
        return self._now(key) >= 1.0

    def take(self, key: Hashable) -> bool:
        """Counts an event; False if it is not allowed."""
        left = self._now(key)
        allowed = left >= 1.0
        self._left[key] = (left - 1.0 if allowed else left, self._clock())
        self._left.move_to_end(key)
        if len(self._left) > MOST_KEYS:
            self._left.popitem(last=False)
        return allowed

    def wait_s(self, key: Hashable) -> float:
        return max(0.0, (1.0 - self._now(key)) / self._per_s)

    def _now(self, key: Hashable) -> float:
        left, at = self._left.get(key, (self._burst, self._clock()))
        return min(self._burst, left + (self._clock() - at) * self._per_s)


def address_key(host: str) -> str:
    """What counts as one address: an IPv4 address, or the /64 network of an IPv6 address, of which a host has many."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return host
    mapped = address.ipv4_mapped
    return str(mapped) if mapped else str(ipaddress.ip_network((int(address), 64), strict=False))


# File descriptors that a server asks the system for; those that it keeps for databases, recordings and jobs; and the
# most connections that it accepts.
DESCRIPTORS, KEPT, MOST = 8192, 512, 4096
# Shares of the connections that may be silent: of all, and of one address. Large ones: who is turned out comes back at
# once, which costs more than a connection that waits for the end of its time.
SILENT, OF_ADDRESS = 0.75, 0.5


class Connections:
    """Counts connections. One is *silent* until the headers of its first request are complete.

    Only silent connections are turned out, the oldest first, so that there is always room for those who have signed in:
    an honest browser sends its headers at once. Whoever then lacks the token gets a refusal, and is disconnected.
    """

    def __init__(self, most: int) -> None:
        self._most, self._most_silent, self._most_of_address = most, int(most * SILENT), int(most * OF_ADDRESS)
        self._addresses: dict[asyncio.Transport, str] = {}
        # a dictionary, since it keeps the order of arrival
        self._silent: dict[asyncio.Transport, None] = {}

    def arrive(self, address: str, transport: asyncio.Transport) -> None:
        """Adds a connection; closes the oldest silent one, or this one, if there are too many."""
        if len(self._addresses) >= self._most and not self._turn_out(self._silent):
            transport.abort()
            return
        self._addresses[transport] = address
        self._silent[transport] = None
        if len(self._silent) > self._most_of_address:
            same = [each for each in self._silent if self._addresses[each] == address]
            if len(same) > self._most_of_address:
                self._turn_out(same)
            elif len(self._silent) > self._most_silent:
                self._turn_out(self._silent)

    def heard(self, transport: asyncio.Transport) -> None:
        """A connection has sent the headers of a request."""
        self._silent.pop(transport, None)

    def leave(self, transport: asyncio.Transport) -> None:
        """Removes a connection that has ended."""
        self.heard(transport)
        self._addresses.pop(transport, None)

    def _turn_out(self, silent: Iterable[asyncio.Transport]) -> bool:
        oldest = next(iter(silent), None)
        if oldest is None:
            return False
        self.leave(oldest)
        oldest.abort()
        return True


def most_connections() -> int:
    """The number of connections for which there are file descriptors; asks the system for more of them."""
    try:
        import resource
    except ImportError:  # not a POSIX system: no such limit
        return MOST
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if 0 <= soft < DESCRIPTORS:
        wanted = DESCRIPTORS if hard == resource.RLIM_INFINITY else min(hard, DESCRIPTORS)
        # some systems permit fewer than they say
        with suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    return MOST if soft < 0 else max(64, min(MOST, soft - KEPT))


# Time for the headers of a request: of the first one from the connection's beginning, else from their first byte.
HEADERS_WITHIN_S = 10.0
# A body must bring this many bytes, or its end, in each such time.
BODY_EVERY_S, BODY_BYTES = 30.0, 32 * 1024


class LimitedConfig(uvicorn.Config):
    """uvicorn's configuration, with the server's connections."""

    def __init__(self, app: Any, connections: Connections, **options: Any) -> None:
        super().__init__(app, http=LimitedHttp, ws=LimitedSocket, **options)
        self.open = connections


class LimitedHttp(H11Protocol):
    """HTTP on one connection; ends it if headers or a body take too long.

    uvicorn's own timer runs only between requests, and middleware sees a request only when its headers are complete.
    """

    config: LimitedConfig

    def __init__(
        self,
        config: LimitedConfig,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._timer: asyncio.TimerHandle | None = None
        self._awaited: Literal["headers", "body"] | None = None
        self._received = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Counts the connection, and starts the time for its first headers."""
        super().connection_made(transport)
        self.config.open.arrive(address_key(self.client[0] if self.client else ""), transport)
        self._watch()

    def data_received(self, data: bytes) -> None:
        """Handles data, and starts or ends the time for what is awaited next."""
        self._received += len(data)
        super().data_received(data)
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop()
        self.config.open.leave(self.transport)
        super().connection_lost(exc)

    def _watch(self) -> None:
        state = None if self.transport.get_protocol() is not self else self.conn.their_state
        awaited: Literal["headers", "body"] | None = (
            "headers" if state is h11.IDLE else "body" if state is h11.SEND_BODY else None
        )
        if awaited == self._awaited:
            return
        self._stop()
        self._awaited, self._received = awaited, 0
        if awaited != "headers":
            self.config.open.heard(self.transport)
        if awaited is not None:
            wait_s = HEADERS_WITHIN_S if awaited == "headers" else BODY_EVERY_S
            self._timer = self.loop.call_later(wait_s, self._too_late)

    def _too_late(self) -> None:
        # while reading pauses, the application is slow, not the client
        if self._awaited == "body" and (self.flow.read_paused or self._received >= BODY_BYTES):
            self._received = 0
            self._timer = self.loop.call_later(BODY_EVERY_S, self._too_late)
            return
        self.transport.abort()

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


class LimitedSocket(WebSocketsSansIOProtocol):
    """A WebSocket, which began as a connection of `LimitedHttp`."""

    config: LimitedConfig

    def connection_lost(self, exc: Exception | None) -> None:
        self.config.open.leave(self.transport)
        super().connection_lost(exc)


# A place in the code may log so many messages at once, and so many a second in the long run.
BURST, PER_S = 20, 1.0
# The file, and the older ones that are kept beside it.
FILE, FILE_BYTES, OLDER_FILES = "server.log", 1 << 20, 2


class FewLines(logging.Filter):
    """Leaves out messages of a place in the code that logs too many, and says how many with the next one."""

    def __init__(self) -> None:
        super().__init__()
        self._rate = Rate(PER_S, BURST)
        self._left_out: dict[tuple[str, int], int] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """False for a message to leave out."""
        known = vars(record)
        if "is_left_out" not in known:  # once for all handlers
            known["is_left_out"] = self._is_left_out(record)
        return not known["is_left_out"]

    def _is_left_out(self, record: logging.LogRecord) -> bool:
        place = (record.pathname, record.lineno)
        if not self._rate.take(place):
            self._left_out[place] = self._left_out.get(place, 0) + 1
            return True
        if count := self._left_out.pop(place, 0):
            record.msg, record.args = f"{record.getMessage()} (and {count} more like this, left out)", None
        return False


@contextmanager
def limited_log(folder: Path | None) -> Iterator[None]:
    """Within the `with` block, warnings of all libraries are logged to the terminal and to a file in the folder.

    No file is kept in a folder that cannot be written.
    """
    root, few = logging.getLogger(), FewLines()
    handlers: list[logging.Handler] = [logging.StreamHandler()]
    if folder is not None:
        try:
            handlers.append(_PrivateFile(folder / FILE))
        except OSError as error:
            logging.getLogger("annotator.web").warning("%s: no log is kept: %s", folder / FILE, error)
    for handler in handlers:
        handler.setLevel(logging.WARNING)
        handler.addFilter(few)
        root.addHandler(handler)
    try:
        yield
    finally:
        for handler in handlers:
            root.removeHandler(handler)
            handler.close()


class _PrivateFile(RotatingFileHandler):
    """A log that rotates, and that only its owner may read."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, maxBytes=FILE_BYTES, backupCount=OLDER_FILES, encoding="utf-8")
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))

    def _open(self) -> TextIOWrapper:
        make_private(Path(self.baseFilename))
        return super()._open()
