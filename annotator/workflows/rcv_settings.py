"""The recursion's settings of a project: command line over a file over `project.json` over the defaults."""

from __future__ import annotations

import json
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path

from pydantic import BaseModel, JsonValue, RootModel, ValidationError
from pydantic_core import ErrorDetails

from annotator.detection.trained import read_trained
from annotator.formats.json_file import read_model
from annotator.project import Project, Role
from annotator.project.config import CONFIG_FILE
from annotator.rcv.config import RcvConfig
from annotator.types.errors import ConfigError, FormatError

Settings = Mapping[str, JsonValue]
"""Any of `RcvConfig`'s fields, groups as objects with any of theirs."""

# What follows from something else, and from what.
DERIVED = {
    "orientation": "follows from the rotation: settings.rotation of the project, or --rotation",
    "box_kind": "follows from the boxes that the pseudo-view detector learnt from",
}


class _File(RootModel[dict[str, JsonValue]]):
    """What a settings file holds, before its fields are looked at."""


def rcv_config(
    project: Project, file: Path | None = None, options: Settings | None = None, *, view_px: int | None = None
) -> RcvConfig:
    """The settings that the recursion, and all that draws pseudo-views for it, has in a project.

    Args:
        file: JSON with any of the fields; wins over `settings.rcv` of `project.json`.
        options: from the command line; win over both.
        view_px: the size of pseudo-views where nothing says it, pixels; None takes the size that the project's detector
            was trained at, since that is what it is best asked at, else the default.

    Raises:
        ConfigError: an unknown field or a value out of its range, with the file and the field.
        FormatError: the file cannot be read, or is no JSON object.
    """
    # its own names come first: the message shall name the place to repair
    stored = _checked(project.config.settings.rcv, f"{project.path / CONFIG_FILE}: settings.rcv.")
    given = {} if file is None else _checked(read_model(file, _File).root, f"{file}: ")
    asked = _checked(options or {}, "command line: ")
    config = _validated(_merged(_merged(stored, given), asked))
    if "size_px" in config.view.model_fields_set:
        return config
    size_px = view_px or _trained_px(project) or config.view.size_px
    return config.model_copy(update={"view": config.view.model_copy(update={"size_px": size_px})})


def _trained_px(project: Project) -> int | None:
    """The picture size of the project's pseudo-view detector; None where there is none, or none that can be read (who
    wants to use it is told so)."""
    model = project.models.active(Role.VIEW)
    if model is None:
        return None
    try:
        return read_trained(model.path.parent).image_size_px
    except FormatError:
        return None


def editable(config: RcvConfig) -> str:
    """All settings as JSON text, as a settings file has them."""
    return json.dumps(config.model_dump(mode="json", exclude=set(DERIVED)), indent=2)


def _checked(settings: Settings, place: str) -> Settings:
    for name, reason in DERIVED.items():
        if name in settings:
            raise ConfigError(f"{place}{name}: is no setting: it {reason}")
    try:
        _validated(settings)
    except ValidationError as error:
        raise ConfigError(place + _told(error.errors()[0])) from error
    return settings


def _validated(settings: Settings) -> RcvConfig:
    # strict as JSON: enums are words there, and a number in quotes is a mistake
    return RcvConfig.model_validate_json(json.dumps(settings), strict=True)


def _told(problem: ErrorDetails) -> str:
    where = ".".join(map(str, problem["loc"]))
    if problem["type"] != "extra_forbidden":
        return f"{where}: {problem['msg'].replace('Input should be', 'must be')}, not {problem['input']!r}"
    known = list(_fields(problem["loc"][:-1]))
    near = get_close_matches(str(problem["loc"][-1]), known, 1)
    meant = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(known)}"
    return f"{where}: there is no such setting; {meant} (`annotator annotate PROJECT --show-config` prints all)"


def _fields(group: tuple[int | str, ...]) -> list[str]:
    model: type[BaseModel] = RcvConfig
    for name in group:
        nested = model.model_fields[str(name)].annotation
        assert isinstance(nested, type)  # only groups can hold an unknown field
        model = nested
    return [name for name in model.model_fields if name not in DERIVED]


def _merged(under: Settings, over: Settings) -> dict[str, JsonValue]:
    merged = dict(under)
    for name, value in over.items():
        below = merged.get(name)
        merged[name] = _merged(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged
