"""Jobs of a server in threads of its process, which start at once; test_web_jobs.py has the real processes."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

from annotator.types.errors import AnnotatorError
from annotator.web.jobs.records import (
    PAUSE,
    RESUME,
    STOP,
    WORKER_MESSAGE,
    Failed,
    Finished,
    JobStoppedError,
    Order,
    Stopped,
    WorkerMessage,
)
from annotator.web.jobs.worker import Orders, _work


class WorkerThread:
    """In place of `WorkerProcess`."""

    pid = 0

    def __init__(self, order: Order, log: Path) -> None:
        self.exit_code: int | None = None
        self._orders = Orders()
        self._sent: SimpleQueue[WorkerMessage | None] = SimpleQueue()
        threading.Thread(target=self._run, args=(order,), daemon=True).start()

    def send(self, message: WorkerMessage) -> None:
        # as if it came from another process
        self._sent.put(WORKER_MESSAGE.validate_json(message.model_dump_json()))

    def messages(self) -> Iterator[WorkerMessage]:
        yield from iter(self._sent.get, None)

    def stop(self, grace_s: float = 0.0) -> None:
        self._orders.take(STOP)

    def pause(self, is_paused: bool) -> None:
        self._orders.take(PAUSE if is_paused else RESUME)

    def _run(self, order: Order) -> None:
        try:
            outcome = _work(order, self, self._orders)
            self.send(Finished(message=outcome.message, result=outcome.result))
        except JobStoppedError as error:
            self.send(Stopped(message=str(error)))
        except AnnotatorError as error:
            self.send(Failed(message=str(error), is_fault=False))
        except Exception:
            self.send(Failed(message=traceback.format_exc(), is_fault=True))
        self.exit_code = 0
        self._sent.put(None)
