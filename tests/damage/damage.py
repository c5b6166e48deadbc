"""Random damage of files, the same for the same seed."""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable, Iterator
from typing import Any

TEXT_SUFFIXES = {".txt", ".json", ".csv", ".xml", ".yaml", ""}
# Numbers and texts that have broken readers, or might.
WORDS = [
    "nan", "inf", "-inf", "NaN", "-1", "0", "1e308", "-1e308", "1e-320", "1e999", "9" * 5000, "1_0", "0x10", "٣", "x",
    "", " ", "\n", "\0", '"', "'", ",", "null", "true", "[]", "{}", "[" * 3000, '"../../x"', '"/x"', '"\\ud800"',
    f'"{"x" * 5000}"', "1e17", "99999999999999999999", "2147483648", "4294967295",
]  # fmt: skip
WORD = re.compile(rb'"(?:[^"\\]|\\.)*"|[-+.\w]+')
# Of JSON: values of another type, and numbers whose squares overflow.
VALUES: list[Any] = [
    None, True, -1, 0, 2**31, 2**63, 2**70, 1e308, 1e-320, float("nan"), float("inf"), "", "../../x", "\0", [], {},
    [1e200] * 10, [[]], "x" * 5000,
]  # fmt: skip
# Sizes and counts in headers.
NUMBERS = [0, 1, 2**15, 2**16 - 1, 2**24, 2**30, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**64 - 1]
HEAD_BYTES, END_BYTES = 300, 200


def damaged(content: bytes, suffix: str, draw: random.Random) -> bytes:
    """Returns a damaged copy of a file's content: one to three random changes."""
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        kinds: list[Callable[[bytes, random.Random], bytes]] = [*BINARY]
        if suffix in TEXT_SUFFIXES:
            kinds += [_other_word] * len(BINARY)
        if suffix == ".json":
            kinds += [_other_value] * len(BINARY)
        content = draw.choice(kinds)(content, draw)
    return content


def _place(content: bytes, draw: random.Random) -> int:
    """Returns an offset; headers and ends of files are short, but decide most."""
    size = len(content)
    begin, end = draw.choice(((0, min(HEAD_BYTES, size)), (max(size - END_BYTES, 0), size), (0, size), (0, size)))
    return draw.randint(begin, end)


def _cut(content: bytes, draw: random.Random) -> bytes:
    return content[: _place(content, draw)]


def _noise(content: bytes, draw: random.Random) -> bytes:
    at, noise = _place(content, draw), draw.randbytes(draw.randint(1, 8))
    return content[:at] + noise + content[at + draw.choice((0, len(noise))) :]


def _flip(content: bytes, draw: random.Random) -> bytes:
    at = _place(content, draw)
    return content[:at] + bytes(byte ^ 1 << draw.randrange(8) for byte in content[at : at + 1]) + content[at + 1 :]


def _number(content: bytes, draw: random.Random) -> bytes:
    at, length = _place(content, draw), draw.choice((1, 2, 4, 8))
    number = (draw.choice(NUMBERS) & (1 << 8 * length) - 1).to_bytes(length, draw.choice(("little", "big")))
    return content[:at] + number + content[at + length :]


def _float(content: bytes, draw: random.Random) -> bytes:
    at, kind = _place(content, draw), draw.choice("fd")
    value = draw.choice((float("nan"), float("inf"), 3e38, 1e-40, 0.0, -1.0))
    number = struct.pack(draw.choice("<>") + kind, value)
    return content[:at] + number + content[at + len(number) :]


def _repeat(content: bytes, draw: random.Random) -> bytes:
    at = _place(content, draw)
    end = draw.choice((len(content), at + draw.randint(1, 64)))
    return content[:at] + content[at:end] * draw.randint(2, 4) + content[end:]


def _lose(content: bytes, draw: random.Random) -> bytes:
    at = _place(content, draw)
    return content[:at] + content[at + draw.randint(1, 64) :]


def _blank(content: bytes, draw: random.Random) -> bytes:
    at, length = _place(content, draw), draw.choice((16, 512, 65536))
    return content[:at] + draw.choice((b"\0", b"\xff")) * length + content[at + length :]


def _nothing(content: bytes, draw: random.Random) -> bytes:
    return b""


def _other_word(content: bytes, draw: random.Random) -> bytes:
    words = [match.span() for match in WORD.finditer(content)]
    if not words:
        return content
    begin, end = draw.choice(words)
    return content[:begin] + draw.choice(WORDS).encode() + content[end:]


def _other_value(content: bytes, draw: random.Random) -> bytes:
    try:
        document = json.loads(content)
    except (ValueError, RecursionError):
        return content
    places = [*_places(document)]
    *outer, last = draw.choice(places) or (None,)
    if last is None:
        return json.dumps(draw.choice(VALUES)).encode()
    part = document
    for key in outer:
        part = part[key]
    if draw.random() < 0.2:
        del part[last]
    else:
        part[last] = draw.choice(VALUES)
    return json.dumps(document).encode()


def _places(value: Any, here: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yields the path to every part of a document."""
    yield here
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        yield from _places(part, (*here, key))


BINARY = [_cut, _noise, _noise, _flip, _number, _number, _float, _repeat, _lose, _blank, _nothing]
