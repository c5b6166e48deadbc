"""The server's log: few lines a second, on the terminal and in a file that rotates."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from logging.handlers import RotatingFileHandler
from pathlib import Path

from annotator.files import make_private
from annotator.web.limits.rates import Rate

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
        place = (record.pathname, record.lineno)
        if not self._rate.take(place):
            self._left_out[place] = self._left_out.get(place, 0) + 1
            return False
        if count := self._left_out.pop(place, 0):
            record.msg, record.args = f"{record.getMessage()} (and {count} more like this, left out)", None
        return True


@contextmanager
def limited_log(folder: Path | None) -> Iterator[None]:
    """Within the `with` block, warnings of all libraries are logged to the terminal and to a file.

    Args:
        folder: for the file; None, or one that cannot be written: no file.
    """
    root, few = logging.getLogger(), FewLines()
    handlers: list[logging.Handler] = [logging.StreamHandler()]
    if folder is not None:
        try:
            handlers.append(_PrivateFile(folder / FILE))
        except OSError as error:
            logging.getLogger("annotator.web").warning("%s: no log is kept: %s", folder / FILE, error)
    handler = _Several(handlers)
    handler.addFilter(few)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()


class _Several(logging.Handler):
    """Handlers behind one filter, which must see each message once."""

    def __init__(self, handlers: list[logging.Handler]) -> None:
        super().__init__(logging.WARNING)
        self._handlers = handlers

    def emit(self, record: logging.LogRecord) -> None:
        for handler in self._handlers:
            handler.handle(record)

    def close(self) -> None:
        for handler in self._handlers:
            handler.close()
        super().close()


class _PrivateFile(RotatingFileHandler):
    """A log that rotates, and that only its owner may read."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, maxBytes=FILE_BYTES, backupCount=OLDER_FILES, encoding="utf-8")
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))

    def _open(self) -> TextIOWrapper:
        make_private(Path(self.baseFilename))
        return super()._open()
