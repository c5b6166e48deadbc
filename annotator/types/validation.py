"""What pydantic says about a value from a file, in words that name nothing of the program."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError

# Kinds of errors whose message names a class of the program.
_NAMING_A_CLASS = ("model_type", "model_attributes_type", "dataclass_type", "is_instance_of")


def first_problem(error: ValidationError, *within: str | int) -> str:
    """Returns the first problem in one line, after its place: "annotations.3.bbox: Field required".

    Args:
        within: the place of the value itself.
    """
    first = error.errors(include_url=False, include_context=False)[0]
    where = ".".join(map(str, (*within, *first["loc"])))
    # pydantic prefixes the messages of custom validators
    problem = first["msg"].removeprefix("Value error, ")
    if first["type"] in _NAMING_A_CLASS:
        problem = "Input should be an object with named fields"
    return f"{where}: {problem}" if where else problem
