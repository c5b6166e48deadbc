"""Numbers in text files."""

from __future__ import annotations

import math
from pathlib import Path

from annotator.types.errors import FormatError

# Of a text that is no number.
SHOWN = 40


def finite_number(text: str, path: Path, line: int, name: str = "") -> float:
    """The number that a text is.

    Args:
        path, line: where it stands, for messages.
        name: of the field, for messages.

    Raises:
        FormatError: it is no number, or not finite.
    """
    told = f"{name}: {text[:SHOWN]!r}" if name else f"{text[:SHOWN]!r}"
    try:
        # float() reads 1_000, too
        value = float(text.replace("_", "?"))
    except ValueError:
        raise FormatError(path, f"{told} is not a number", line) from None
    if not math.isfinite(value):
        raise FormatError(path, f"{told} is not a finite number", line)
    return value
