"""How often something may happen, for each address or each place in the code."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable

# Number of keys that are remembered; the one that was not used for the longest time is forgotten first.
MOST_KEYS = 4096


class Rate:
    """At most `burst` events at once, and `per_s` a second in the long run, counted for each key."""

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s, self._burst, self._clock = per_s, float(burst), clock
        # key -> how many more events are allowed, and at what time; the key used last is at the end
        self._left: OrderedDict[Hashable, tuple[float, float]] = OrderedDict()

    def allows(self, key: Hashable) -> bool:
        """True if an event is allowed now."""
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
        """Seconds until an event is allowed."""
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
