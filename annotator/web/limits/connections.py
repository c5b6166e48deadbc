"""The open connections of a server. A connection is *silent* until the headers of its first request are complete.

Only silent connections are turned out, the oldest first, so that there is always room for those who have signed in: an
honest browser sends its headers at once. Whoever then lacks the token gets a refusal, and is disconnected.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress

# File descriptors that a server asks the system for; those that it keeps for databases, recordings and jobs; and the
# most connections that it accepts.
DESCRIPTORS, KEPT, MOST = 8192, 512, 4096
# Shares of the connections that may be silent: of all, and of one address. Large ones: who is turned out comes back at
# once, which costs more than a connection that waits for the end of its time.
SILENT, OF_ADDRESS = 0.75, 0.5


class Connections:
    """Counts connections, and closes the oldest silent ones if there are too many."""

    def __init__(self, most: int) -> None:
        """
        Args:
            most: number of connections; the numbers of silent ones follow from it.
        """
        self._most, self._most_silent, self._most_of_address = most, int(most * SILENT), int(most * OF_ADDRESS)
        self._addresses: dict[asyncio.Transport, str] = {}
        # dictionaries, since they keep the order of arrival
        self._silent: dict[asyncio.Transport, None] = {}
        self._silent_of: dict[str, dict[asyncio.Transport, None]] = {}

    def __len__(self) -> int:
        return len(self._addresses)

    @property
    def silent(self) -> int:
        """The number of silent connections."""
        return len(self._silent)

    def arrive(self, address: str, transport: asyncio.Transport) -> None:
        """Adds a connection; closes the oldest silent one, or this one, if there are too many.

        Args:
            address: of the client, as in `address_key`.
        """
        if len(self._addresses) >= self._most and not self._turn_out(self._silent):
            transport.abort()
            return
        self._addresses[transport] = address
        self._silent[transport] = None
        same = self._silent_of.setdefault(address, {})
        same[transport] = None
        if len(same) > self._most_of_address:
            self._turn_out(same)
        elif len(self._silent) > self._most_silent:
            self._turn_out(self._silent)

    def heard(self, transport: asyncio.Transport) -> None:
        """A connection has sent the headers of a request."""
        if transport in self._silent:
            del self._silent[transport]
            address = self._addresses[transport]
            same = self._silent_of[address]
            del same[transport]
            if not same:
                del self._silent_of[address]

    def leave(self, transport: asyncio.Transport) -> None:
        """Removes a connection that has ended."""
        self.heard(transport)
        self._addresses.pop(transport, None)

    def _turn_out(self, silent: dict[asyncio.Transport, None]) -> bool:
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
