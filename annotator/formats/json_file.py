"""JSON files with a pydantic model: read with errors that say where, written all or not at all."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from annotator.files import read_at_most, write_atomic
from annotator.types.errors import FormatError

# The largest that is in use, COCO's training labels, has 450 MB.
MAX_BYTES = 2**30
HALF_CHARACTER = re.compile(rb"\\u[dD][89a-fA-F]")

Model = TypeVar("Model", bound=BaseModel)
PairsHook = Callable[[list[tuple[str, object]]], object]


def no_twins(pairs: list[tuple[str, object]]) -> dict[str, object]:
    """JSON objects as dicts; a key that is there twice would silently lose labels, so it is a KeyError."""
    content: dict[str, object] = {}
    for key, value in pairs:
        if key in content:
            raise KeyError(key)
        content[key] = value
    return content


def read_model(path: Path, model: type[Model], pairs_hook: PairsHook | None = None) -> Model:
    """The content of a JSON file, validated.

    Args:
        pairs_hook: as of `read_json`.

    Raises:
        FormatError: the file cannot be read, is no JSON (with the line), or does not fit the model (with the
            place within the file, such as `annotations.3.bbox`).
    """
    content = read_json(path, pairs_hook)
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise FormatError(path, first_problem(error)) from error


def read_json(path: Path, pairs_hook: PairsHook | None = None) -> object:
    """The content of a JSON file.

    Args:
        pairs_hook: makes an object of its pairs in place of `dict`, such as `no_twins`; a KeyError of it says which key
            is there twice.

    Raises:
        FormatError: the file cannot be read, is longer than `MAX_BYTES`, or is no JSON (with the line).
    """
    try:
        data = read_at_most(path, MAX_BYTES)
    except OSError as error:
        raise FormatError(path, f"cannot be read ({error.strerror})") from error
    if len(data) > MAX_BYTES:
        raise FormatError(path, f"is longer than {MAX_BYTES // 2**20} MiB; split it")
    try:
        content: object = json.loads(data.decode("utf-8-sig"), object_pairs_hook=pairs_hook)
    except UnicodeDecodeError as error:
        raise FormatError(path, "is not UTF-8 text; save it as UTF-8") from error
    except json.JSONDecodeError as error:
        raise FormatError(path, f"is not valid JSON: {error.msg} (column {error.colno})", error.lineno) from error
    except RecursionError as error:
        raise FormatError(path, "is nested too deeply to be a label file") from error
    except KeyError as error:
        raise FormatError(path, f"the key {error} is there twice; keep one of them") from error
    except ValueError as error:
        # an integer of thousands of digits
        raise FormatError(path, f"has a number that cannot be read ({error})") from error
    if HALF_CHARACTER.search(data):
        _require_whole_characters(path, content)
    return content


def _require_whole_characters(path: Path, content: object) -> None:
    r"""JSON may spell halves of a character (`\ud800`), which nobody could write down or show again."""
    try:
        json.dumps(content, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        raise FormatError(path, f"has half a character ({error.object[error.start]!a})") from error


def first_problem(error: ValidationError) -> str:
    """The first of a model's complaints in one line, and how many more there are."""
    problems = error.errors(include_url=False, include_context=False)
    first = problems[0]
    where = ".".join(str(part) for part in first["loc"]) or "the file"
    more = f" (and {len(problems) - 1} more problems)" if len(problems) > 1 else ""
    return f"{where}: {first['msg']}{more}"


def write_text(path: Path, text: str) -> None:
    """Writes a text file by way of a temporary sibling, so that a reader sees the old file or the new one.

    Raises:
        FormatError: the file cannot be written.
    """
    try:
        write_atomic(path, text.encode())
    except OSError as error:
        raise FormatError(path, f"cannot be written ({error.strerror})") from error
