"""JSON files: read into pydantic models, or pair by pair if they are large; and number fields with limits."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Never, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from annotator.files import read_file, write_atomic
from annotator.text import decoded
from annotator.types.errors import FormatError
from annotator.types.label import MOST_TRACK
from annotator.types.messages import amount, first_problem

# The largest label file in common use, COCO's training labels, takes 450 MB.
MAX_BYTES = 2**30
SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")

Model = TypeVar("Model", bound=BaseModel)


class FileRecord(BaseModel):
    """A part of a file; other fields, which other tools may write, are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


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
    data = _read(path)
    with json_faults(path):
        text = decoded(data)
        content: object = json.loads(text, object_pairs_hook=pairs_hook)
    require_encodable(path, text, content)
    return content


def _read(path: Path) -> bytes:
    try:
        return read_file(path, MAX_BYTES)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error


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


BLANKS = re.compile(r"[ \t\r\n]*+")


def read_pairs(path: Path, inside: str | None = None) -> Iterator[tuple[str, object]]:
    """Yields the pairs of the object in a file, in its order, each key once; they are parsed one by one.

    Args:
        inside: the key of the object's pair whose own pairs are wanted, instead of the object's.
    """
    data = _read(path)
    with json_faults(path):
        text, found = _Text(path, decoded(data)), False
        del data
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
    """The text of a file, and a place in it."""

    def __init__(self, path: Path, text: str) -> None:
        self._path, self._text, self._at = path, text, 0
        self._json = json.JSONDecoder(object_pairs_hook=unique_keys)

    def begin_object(self) -> Iterator[str]:
        """Yields the keys of the object that begins here; each key's value must be read before the next one."""
        if self.next_character() != "{":
            self.fail("must be a JSON object with one entry per frame")
        self._at += 1
        known, is_first = set[str](), True
        while not (is_first and self.next_character() == "}"):
            is_first = False
            if self.next_character() != '"':
                self.fail("is not valid JSON: a key in double quotes is missing")
            key = str(self.value())
            if key in known:
                raise KeyError(key)
            known.add(key)
            self._take(":")
            yield key
            if self.next_character() == "}":
                break
            self._take(",")
        self._at += 1

    def value(self) -> object:
        """Reads the value that begins here."""
        self.next_character()
        value, end = self._json.raw_decode(self._text, self._at)
        require_encodable(self._path, self._text[self._at : end], value)
        self._at = end
        return value

    def next_character(self) -> str:
        """Goes to the next character that is not blank, and returns it; "" at the end of the file."""
        match = BLANKS.match(self._text, self._at)
        assert match is not None  # it may be empty
        self._at = match.end()
        return self._text[self._at : self._at + 1]

    def _take(self, character: str) -> None:
        if self.next_character() != character:
            self.fail(f"is not valid JSON: Expecting '{character}'")
        self._at += 1

    def fail(self, reason: str) -> Never:
        """Raises FormatError for what is here."""
        raise FormatError(self._path, reason, 1 + self._text.count("\n", 0, self._at))
