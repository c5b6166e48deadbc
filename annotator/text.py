"""Text in files as people's tools write it: its encoding, and the numbers in it."""

from __future__ import annotations

import codecs
import re

# The mark of UTF-32 begins with that of UTF-16.
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# Bytes at the beginning of a file that tell its encoding.
MARK_BYTES = 4
# Characters of an invalid number that a message quotes.
SHOWN = 40
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?|[+-]?\d{1,3}(\.\d{3})*,\d*")


class NotTextError(UnicodeDecodeError):
    """A file is not text in an encoding that is read; its message says where, and what to do."""

    def __str__(self) -> str:
        line = self.object.count(b"\n", 0, self.start) + 1
        return f"not {self.encoding.upper()} text in line {line} ({self.object[self.start]:#04x}); save it as UTF-8"


def encoding_of(head: bytes) -> str:
    """Returns the encoding that the mark at the beginning of a file names; UTF-8 without one."""
    return next((encoding for mark, encoding in _MARKS if head.startswith(mark)), "utf-8-sig")


def decoded(content: bytes, errors: str = "strict") -> str:
    """Returns the text of a file without its byte order mark: UTF-8, or what the mark names; lines end as they do.

    Raises:
        NotTextError: it has another encoding.
    """
    encoding = encoding_of(content[:MARK_BYTES])
    try:
        return content.decode(encoding, errors)
    except UnicodeDecodeError as error:
        name = encoding.removesuffix("-sig")
        raise NotTextError(name, content, error.start, error.end, error.reason) from None


def to_number(text: str) -> float:
    """Returns a text as a number; it may be infinite or none (`nan`).

    Raises:
        ValueError: it is not one; the message quotes it, and names a decimal comma.
    """
    try:
        # float() would accept 1_000
        return float(text.replace("_", "?"))
    except ValueError:
        pass
    has_comma = any(_DECIMAL_COMMA.fullmatch(part.strip()) for part in text.split(";"))
    problem = "has a decimal comma; write a point" if has_comma else "is not a number"
    raise ValueError(f"{text[:SHOWN]!r} {problem}")
