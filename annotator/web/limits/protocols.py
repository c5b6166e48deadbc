"""uvicorn's protocols with times for headers and bodies, from the beginning of a connection.

uvicorn's own timer runs only between requests, and middleware sees a request only when its headers are complete.
"""

from __future__ import annotations

import asyncio
from typing import Any, Literal

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from annotator.web.limits.connections import Connections
from annotator.web.limits.rates import address_key

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
    """HTTP on one connection; ends it if headers or a body take too long."""

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
        """Forgets the connection."""
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
        """Forgets the connection."""
        self.config.open.leave(self.transport)
        super().connection_lost(exc)
