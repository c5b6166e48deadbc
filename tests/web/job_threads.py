"""Jobs of a server in threads of its process, which start at once; test_web_jobs.py has the real processes."""

from __future__ import annotations

import pickle
import threading
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

from annotator.web.jobs.records import PAUSE, STOP, Order, WorkerMessage
from annotator.web.jobs.worker import Orders, run


class WorkerThread:
    """In place of `WorkerProcess`."""

    exit_code = 0

    def __init__(self, order: Order, log: Path) -> None:
        self._orders, self._sent = Orders(), SimpleQueue[WorkerMessage | None]()
        threading.Thread(target=self._run, args=(order,), daemon=True).start()

    def _run(self, order: Order) -> None:
        run(order, self._send, self._orders)
        self._sent.put(None)

    def _send(self, message: WorkerMessage) -> None:
        # as if it came from another process
        copied: WorkerMessage = pickle.loads(pickle.dumps(message))
        self._sent.put(copied)

    def messages(self) -> Iterator[WorkerMessage]:
        yield from iter(self._sent.get, None)

    def stop(self, grace_s: float | None = None) -> None:
        self._orders.take(STOP)

    def pause(self) -> None:
        self._orders.take(PAUSE)
