"""What becomes of a fault in a file of labels: it ends the reading, or it is told and the rest is read on."""

from __future__ import annotations

from collections.abc import Callable

from annotator.types.errors import FormatError

Tell = Callable[[FormatError], None]
"""Is called with a fault; where it returns, what is faulty is left out and the reading goes on."""


def give_up(fault: FormatError) -> None:
    """Ends the reading.

    Raises:
        FormatError: the fault itself.
    """
    raise fault
