"""The open workbenches of a server: a bounded number an operator, and none that nobody looks at."""

from __future__ import annotations

import logging
import secrets
import threading
import time

from annotator.types.errors import NotFoundError
from annotator.web.viewport.workbench import Send, Workbench

LOG = logging.getLogger("annotator.web")

# Several tabs are fine; a script that opens more than that closes its own oldest ones.
MOST_AN_OPERATOR = 6
# A page that reloads, or a line that breaks, is back sooner than this, seconds.
UNSEEN_S = 60.0
SWEEP_S = 5.0


class Workbenches:
    """Opens, finds and closes workbenches; threads share it."""

    def __init__(
        self,
        send: Send,
        *,
        most: int = MOST_AN_OPERATOR,
        unseen_s: float = UNSEEN_S,
        sweep_s: float = SWEEP_S,
    ) -> None:
        """
        Args:
            send: gets the events of all workbenches.
            most: how many an operator may have open.
            unseen_s: how long one stays open that no page shows, seconds.
            sweep_s: how often to look for such ones, seconds.
        """
        self._send = send
        self._most, self._unseen_s, self._sweep_s = most, unseen_s, sweep_s
        self._lock = threading.Lock()
        self._open: dict[str, Workbench] = {}
        self._stop = threading.Event()
        self._sweeper: threading.Thread | None = None

    def open(self, operator: str, project: str) -> Workbench:
        """A new workbench; an operator's oldest ones close when there are too many."""
        made = Workbench(secrets.token_hex(8), operator, project, self._send)
        with self._lock:
            self._open[made.id] = made
            own = [bench for bench in self._open.values() if bench.operator == operator]
            surplus = [self._open.pop(bench.id) for bench in own[: -self._most]]
            if self._sweeper is None:
                self._sweeper = threading.Thread(target=self._sweep, name="workbenches", daemon=True)
                self._sweeper.start()
        for bench in surplus:
            bench.close()
        return made

    def get(self, id: str, operator: str) -> Workbench:
        """An operator's workbench.

        Raises:
            NotFoundError: there is none of that id, or it is somebody else's.
        """
        with self._lock:
            found = self._open.get(id)
        if found is None or found.operator != operator:
            raise NotFoundError(f"workbench {id} is closed; reload the page to open a new one")
        return found

    def close_one(self, id: str, operator: str) -> None:
        """Closes a workbench.

        Raises:
            NotFoundError: as `get`.
        """
        bench = self.get(id, operator)
        with self._lock:
            gone = self._open.pop(id, None)
        if gone is not None:
            bench.close()

    def close(self) -> None:
        """Closes all of them."""
        self._stop.set()
        with self._lock:
            left = list(self._open.values())
            self._open.clear()
            sweeper, self._sweeper = self._sweeper, None
        for bench in left:
            bench.close()
        if sweeper is not None:
            sweeper.join()

    def connected(self, bench: Workbench, change: int) -> None:
        """A browser has connected to a workbench's viewport (+1), or has gone (-1)."""
        with self._lock:
            bench.sockets += change
            bench.used_s = time.monotonic()
        bench.tell("connected", connected=bench.sockets > 0)

    def _sweep(self) -> None:
        while not self._stop.wait(self._sweep_s):
            now = time.monotonic()
            with self._lock:
                for bench in self._open.values():
                    if bench.sockets > 0:
                        bench.used_s = now
                unseen = [bench for bench in self._open.values() if now - bench.used_s > self._unseen_s]
                for bench in unseen:
                    del self._open[bench.id]
            for bench in unseen:
                LOG.info("workbench %s of %s closed: no page shows it", bench.id, bench.operator)
                bench.close()
