"""The open connections of a server. A *stranger* is a connection that has not shown the token.

Only strangers are turned out, the oldest first, so that those who have signed in always find room. An honest browser
shows its token within milliseconds.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import dataclass

# File descriptors that a server asks the system for; those that it keeps for databases, recordings and jobs; and the
# most connections that it accepts.
DESCRIPTORS, KEPT, MOST = 4096, 512, 2048
# Shares of the connections that strangers may have: all of them, and those of one address.
STRANGERS, OF_ADDRESS = 2, 8


@dataclass(eq=False)
class Visit:
    """One connection.

    Attributes:
        address: of the client, as in `address_key`.
        transport: the connection itself.
    """

    address: str
    transport: asyncio.Transport
    connections: Connections

    def show_token(self) -> None:
        """The client has shown the token, or none is needed."""
        self.connections.forget_stranger(self)


class Connections:
    """Counts connections, and closes the oldest strangers if there are too many."""

    def __init__(self, most: int) -> None:
        """
        Args:
            most: number of connections; the shares of strangers follow from it.
        """
        self._most, self._most_strangers, self._most_of_address = most, most // STRANGERS, max(1, most // OF_ADDRESS)
        self._open: set[Visit] = set()
        # dictionaries, since they keep the order of arrival
        self._strangers: dict[Visit, None] = {}
        self._of_address: dict[str, dict[Visit, None]] = {}

    def __len__(self) -> int:
        return len(self._open)

    @property
    def strangers(self) -> int:
        """The number of strangers."""
        return len(self._strangers)

    def arrive(self, address: str, transport: asyncio.Transport) -> Visit:
        """Adds a connection, as a stranger; closes the oldest stranger, or this one, if there are too many."""
        visit = Visit(address, transport, self)
        if len(self._open) >= self._most and not self._turn_out(self._strangers):
            transport.abort()
            return visit
        self._open.add(visit)
        self._strangers[visit] = None
        same = self._of_address.setdefault(address, {})
        same[visit] = None
        if len(same) > self._most_of_address:
            self._turn_out(same)
        elif len(self._strangers) > self._most_strangers:
            self._turn_out(self._strangers)
        return visit

    def leave(self, visit: Visit) -> None:
        """Removes a connection that has ended."""
        self._open.discard(visit)
        self.forget_stranger(visit)

    def forget_stranger(self, visit: Visit) -> None:
        """A stranger is none any more."""
        self._strangers.pop(visit, None)
        if same := self._of_address.get(visit.address):
            same.pop(visit, None)
            if not same:
                del self._of_address[visit.address]

    def _turn_out(self, strangers: dict[Visit, None]) -> bool:
        oldest = next(iter(strangers), None)
        if oldest is None:
            return False
        self.leave(oldest)
        oldest.transport.abort()
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
