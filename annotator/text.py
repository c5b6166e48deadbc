"""Text in files as people's tools write it: its encoding, the numbers and the names in it.

Names and paths are of any system, in any Unicode form, and never lead out of their folder.
"""

from __future__ import annotations

import codecs
import os
import re
import unicodedata
from pathlib import Path, PurePosixPath

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


# A path on a drive or a share of Windows. A single letter and a colon alone may be a name.
_OF_WINDOWS = re.compile(r"[A-Za-z]:[\\/]|\\\\")
# Characters of an invalid name that a message quotes.
NAME_SHOWN = 60
REMEDY = "write it relative to the folder"


class OutsideError(ValueError):
    """A name that leads out of its folder, or that no file can have; its message quotes it and says which."""


def is_within(folder: Path, path: Path) -> bool:
    """True if a path, as it would be opened, is valid and in a folder after resolving links; it may be missing."""
    try:
        # raises for a name that is too long
        path.exists()
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):
        # too long, a circular link, a null byte
        return False


def inside(folder: Path, name: str) -> Path:
    """Returns the path of a file that another file names, relative to `folder`; it may be missing.

    Backslashes separate folders, as on Windows, unless there is a file of exactly this name. A name in another Unicode
    form than the file's is found.

    Raises:
        OutsideError: it leads out of the folder, also by a link, or is not a valid name.
    """
    if _OF_WINDOWS.match(name):
        raise OutsideError(f"{name[:NAME_SHOWN]!r} is a path of another computer; {REMEDY}")
    path = folder / name
    if "\\" in name and not (is_within(folder, path) and path.exists()):
        name = posix_path(name)
    path = spelled(folder, name)
    if not is_within(folder, path):
        raise OutsideError(f"{name[:NAME_SHOWN]!r} leads out of the folder, or is not a valid name; {REMEDY}")
    return path


def is_absolute(name: str) -> bool:
    """True for a path from the root of a computer, of any system."""
    return name.startswith("/") or bool(_OF_WINDOWS.match(name))


def posix_path(name: str) -> str:
    """Returns a path of any system with `/` between its parts."""
    return name.replace("\\", "/")


def stem_of(name: str) -> str:
    """Returns the name of a file without its folder and suffix, from a path of any system."""
    return PurePosixPath(posix_path(name)).stem


def normal(name: str) -> str:
    """Returns the form of a name in which it is compared: macOS decomposes letters with accents, others do not."""
    return name if name.isascii() else unicodedata.normalize("NFC", name)


def spelled(folder: Path, name: str) -> Path:
    """Returns the path of `name` in a folder in the Unicode form in which it exists there; as given if in none."""
    path = folder / name
    if name.isascii():
        return path
    forms = (path, *(folder / unicodedata.normalize(form, name) for form in ("NFC", "NFD")))
    # unlike `Path.exists`, this is false for a name that is too long, or has a null byte
    return next(filter(os.path.exists, forms), path)
