"""JSON files: reading into pydantic models with errors that name the place, and number fields with limits.

`write_text` writes text files atomically.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, Field, ValidationError

from annotator.files import read_file, write_atomic
from annotator.text import decoded
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

    Raises:
        FormatError: the file cannot be read, is not JSON (names the line), or does not fit the model (names the
            place within the file, such as `annotations.3.bbox`).
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

    Raises:
        FormatError: the file cannot be read, is longer than `MAX_BYTES`, or is not JSON (names the line).
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

    Raises:
        FormatError: there is one.
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
    """Writes a text file atomically: a reader sees the old file or the new one.

    Raises:
        FormatError: the file cannot be written.
    """
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
