"""JSON files: read into pydantic models, or pair by pair if they are large; and number fields with limits."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, BinaryIO, Never, TypeVar

from pydantic import BaseModel, Field, ValidationError

from annotator.files import CHUNK_BYTES, open_file, read_file, write_atomic
from annotator.text import MARK_BYTES, decoded, encoding_of
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK
from annotator.types.messages import amount, first_problem

# The largest label file in common use, COCO's training labels, takes 450 MB.
MAX_BYTES = 2**30
SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

Model = TypeVar("Model", bound=BaseModel)
PairsHook = Callable[[list[tuple[str, object]]], object]


def unique_keys(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """Builds a dict from a JSON object's pairs.

    Raises KeyError for a repeated key; `json` itself would silently keep only the last value.
    """
    content: dict[str, object] = {}
    for key, value in pairs:
        if key in content:
            raise KeyError(key)
        content[key] = value
    return content


def read_model(path: Path, model: type[Model], pairs_hook: PairsHook | None = None) -> Model:
    """Returns the validated content of a JSON file.

    Args:
        pairs_hook: as in `read_json`.
    """
    content = read_json(path, pairs_hook)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FormatError(path, first_problem(error) + _more(error)) from error


def read_json(path: Path, pairs_hook: PairsHook | None = None) -> object:
    """Returns the content of a JSON file.

    Args:
        pairs_hook: builds an object from its pairs, such as `unique_keys`; a KeyError from it names a repeated key.
    """
    try:
        data = read_file(path, MAX_BYTES)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    with json_faults(path):
        text = decoded(data)
        content: object = json.loads(text, object_pairs_hook=pairs_hook)
    require_encodable(path, text, content)
    return content


@contextmanager
def json_faults(path: Path) -> Iterator[None]:
    """Converts the errors of parsing JSON into FormatErrors; a KeyError names a key that occurs twice."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise FormatError(path, f"is {error}") from error
    except json.JSONDecodeError as error:
        raise FormatError(path, f"is not valid JSON: {error.msg} (column {error.colno})", error.lineno) from error
    except RecursionError as error:
        raise FormatError(path, "is nested too deeply to be a label file") from error
    except KeyError as error:
        raise FormatError(path, f"the key {error} occurs twice; keep one of them") from error
    except ValueError as error:
        # an integer of thousands of digits
        raise FormatError(path, f"has a number that cannot be read ({error})") from error


def require_encodable(path: Path, text: str, content: object) -> None:
    r"""Rejects unpaired surrogates (`\ud800`): valid JSON escapes, but they cannot be encoded as UTF-8.

    Args:
        text: the JSON of `content`.
    """
    if SURROGATE.search(text) is None:
        return
    try:
        json.dumps(content, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise FormatError(
            path, f"has an unpaired surrogate ({error.object[error.start]!a}); write the whole character"
        ) from error


def _more(error: ValidationError) -> str:
    more = error.error_count() - 1
    return f" (and {amount(more, 'more problem')})" if more else ""


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically: a reader sees the old file or the new one."""
    try:
        write_atomic(path, text.encode())
    except OSError as error:
        raise FormatError(path, f"cannot be written ({error.strerror})") from error


# Plausibility limit for coordinates and sizes, metres.
MOST = 1e14

Bounded = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
BoundedPositive = Annotated[float, Field(gt=0, le=MOST, allow_inf_nan=False)]
# Track ids; `Exact` is for formats that store every number as a float.
BoundedTrack = Annotated[int, Field(ge=-MOST_TRACK, le=MOST_TRACK)]
Exact = Annotated[float, Field(ge=-MOST_TRACK, le=MOST_TRACK, allow_inf_nan=False)]
Bounded3 = tuple[Bounded, Bounded, Bounded]
Bounded4 = tuple[Bounded, Bounded, Bounded, Bounded]


# The longest value, such as all boxes of a frame, characters.
MOST_VALUE = 2**26
BLANKS = re.compile(r"[ \t\r\n]*+")
# What may belong to a number, up to the end of what was read.
CUT_NUMBER = re.compile(r"[-+.\deE]*+\Z")
# A number or a word at the end of what was read may go on.
LONGEST_WORD = 32


def read_pairs(path: Path, inside: str | None = None) -> Iterator[tuple[str, object]]:
    """Yields the pairs of the object in a file, in its order, each key once.

    Args:
        inside: the key of the object's pair whose own pairs are wanted, instead of the object's.
    """
    try:
        file = open_file(path, MAX_BYTES)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    with file, json_faults(path):
        text, found = _Text(path, file), False
        for key in text.begin_object():
            if inside is None:
                yield key, text.value()
            elif key == inside:
                found = True
                for name in text.begin_object():
                    yield name, text.value()
            else:
                text.value()
        if text.next_character():
            text.fail("has something after the end of its object")
        if inside is not None and not found:
            raise FormatError(path, f"has no key {inside!r}")


class _Text:
    """The part of the file between what was read and what comes next."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self._path, self._file = path, file
        head = file.read(MARK_BYTES)
        file.seek(0)
        self._bytes = codecs.getincrementaldecoder(encoding_of(head))()
        self._json = json.JSONDecoder(object_pairs_hook=unique_keys)
        self._text, self._at, self._line, self._ended = "", 0, 1, False

    def begin_object(self) -> Iterator[str]:
        """Yields the keys of the object that begins here; each key's value must be read before the next one."""
        if self.next_character() != "{":
            self.fail("must be a JSON object with one entry per frame")
        self._at += 1
        known = set[str]()
        if self.next_character() == "}":
            self._at += 1
            return
        while True:
            if self.next_character() != '"':
                self.fail("is not valid JSON: a key in double quotes is missing")
            key = str(self.value())
            if key in known:
                raise KeyError(key)
            known.add(key)
            self._take(":")
            yield key
            if self.next_character() == "}":
                self._at += 1
                return
            self._take(",")

    def value(self) -> object:
        """Reads the value that begins here."""
        self.next_character()
        while True:
            try:
                value, end = self._json.raw_decode(self._text, self._at)
            except json.JSONDecodeError as error:
                is_cut = error.msg.startswith("Unterminated") or error.pos >= len(self._text) - LONGEST_WORD
                if not (is_cut and self._more()):
                    self._at = error.pos
                    self.fail(f"is not valid JSON: {error.msg}")
                continue
            if CUT_NUMBER.match(self._text, end) and self._more():
                continue  # a number may go on: of "1.5" and "1e-3", "1" is one, too
            require_encodable(self._path, self._text[self._at : end], value)
            self._at = end
            return value

    def next_character(self) -> str:
        """Goes to the next character that is not blank, and returns it; "" at the end of the file."""
        while True:
            match = BLANKS.match(self._text, self._at)
            assert match is not None  # it may be empty
            self._at = match.end()
            if self._at < len(self._text):
                return self._text[self._at]
            if not self._more():
                return ""

    def _take(self, character: str) -> None:
        if self.next_character() != character:
            self.fail(f"is not valid JSON: Expecting '{character}'")
        self._at += 1

    def _more(self) -> bool:
        """Reads on, the more the longer the value is; False at the end of the file."""
        if self._ended:
            return False
        if len(self._text) - self._at > MOST_VALUE:
            self.fail(f"has an entry of more than {MOST_VALUE >> 20} MiB; divide it")
        read = self._file.read(max(CHUNK_BYTES, len(self._text) - self._at))
        self._ended = not read
        self._line += self._text.count("\n", 0, self._at)
        try:
            more = self._bytes.decode(read, final=self._ended)
        except UnicodeDecodeError:
            self.fail("is not UTF-8 text; save it as UTF-8")
        self._text, self._at = self._text[self._at :] + more, 0
        return True

    def fail(self, reason: str) -> Never:
        """Raises FormatError for what is here."""
        raise FormatError(self._path, reason, self._line + self._text.count("\n", 0, self._at))
