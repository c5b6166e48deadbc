"""The recursion's settings in a project, by precedence: command line, settings file, `project.json`, defaults.

The typical sizes of the project's classes come from its reviewed boxes.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from functools import cache
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from pydantic import JsonValue, RootModel, ValidationError
from pydantic_core import ErrorDetails

from annotator.detection.trained import read_trained
from annotator.formats.reading import read_model
from annotator.project import Project
from annotator.project.config import CONFIG_FILE, BoxRotation
from annotator.rcv.config import RcvConfig, TypicalSize, typical_size
from annotator.types import DetectorKind, OrientedBox
from annotator.types.errors import ConfigError, FormatError
from annotator.types.messages import alternatives

# Number of the latest reviewed boxes of a class that are read, and of those that count: one for each track.
MOST_READ, MOST_BOXES = 300, 60
# Before any box is reviewed: spread of a class that is not well known, the number of boxes that this guess (or the one
# of a well-known class) is worth, and the number that the mean of a well-known class is worth.
SPREAD, WORTH, MEAN_WORTH = 0.2, 2, 1
# A well-known class whose reviewed boxes deviate by more spreads on average is another one of the same name.
FOREIGN = 3.0
# A class of exactly equal boxes still has this spread.
LEAST_SPREAD = 0.03
# How much nearer (mean logarithm of a side) another order of the sides must be to the typical one.
REORDERED = 0.1


def reviewed_sizes(project: Project, without_frames: Collection[int] = ()) -> tuple[TypicalSize, ...]:
    """The typical size of each class with reviewed boxes."""
    sizes = []
    recording_of = cache(lambda frame_id: project.frames.get(frame_id).recording_id)
    for label in project.config.classes:
        # the latest box of each track, and all boxes without one
        boxes: dict[tuple[int, ...], OrientedBox] = {}
        for number, item in enumerate(project.labels.recent(MOST_READ, label=label)):
            if item.frame_id not in without_frames and len(boxes) < MOST_BOXES:
                track_id = item.label.track_id
                track = (number,) if track_id is None else (recording_of(item.frame_id), track_id)
                boxes.setdefault(track, item.label.box)
        if boxes:
            sizes.append(_typical(label, list(boxes.values()), project.config.settings.rotation))
    return tuple(sizes)


def _typical(label: str, boxes: list[OrientedBox], rotation: BoxRotation) -> TypicalSize:
    """Mean and spread of the logarithms of the sides, together with what is known of a class of this name."""
    logs = np.log(np.stack([box.size_m for box in boxes]))
    known = typical_size(label)
    if known is not None:
        ordered = _ordered(logs, np.log(known.size_m), rotation)
        if np.abs((ordered.mean(axis=0) - np.log(known.size_m)) / known.spread).mean() > FOREIGN:
            known = None
    if known is None:
        # the longer of the interchangeable sides first
        free = 3 if rotation is BoxRotation.FREE else 2
        first = np.concatenate([-np.sort(-logs[0, :free]), logs[0, free:]])
        ordered = _ordered(logs, first, rotation)
        mean, spread = ordered.mean(axis=0), np.full(3, SPREAD)
    else:
        mean = (ordered.sum(axis=0) + MEAN_WORTH * np.log(known.size_m)) / (len(boxes) + MEAN_WORTH)
        spread = np.array(known.spread)
    squares = ((ordered - mean) ** 2).sum(axis=0)
    spread = np.clip(np.sqrt((WORTH * spread**2 + squares) / (WORTH + len(boxes))), LEAST_SPREAD, 2.0)
    length, width, height = np.exp(mean).tolist()
    a, b, c = spread.tolist()
    return TypicalSize(label=label, size_m=(length, width, height), spread=(a, b, c))


def _ordered(
    logs: Float64[np.ndarray, "k 3"], like: Float64[np.ndarray, "3"], rotation: BoxRotation
) -> Float64[np.ndarray, "k 3"]:
    """The sides of each box in the order in which they are most like the given ones.

    The third axis of an upright box is its height, and that of other boxes any side; which boxes are upright is only
    known in projects whose rotation is set. So the height is only exchanged if that is clearly more alike.
    """
    orders: list[tuple[int, ...]] = [(0, 1, 2), (1, 0, 2)]
    if rotation is not BoxRotation.UPRIGHT:
        orders += [order for order in permutations(range(3)) if order not in orders]
    candidates = np.stack([logs[:, list(order)] for order in orders], axis=1)
    extra = np.array([0.0 if order[2] == 2 or rotation is BoxRotation.FREE else REORDERED for order in orders])
    best = (np.abs(candidates - like).mean(axis=2) + extra).argmin(axis=1)
    return np.asarray(candidates[np.arange(len(logs)), best])


Settings = Mapping[str, Any]
"""Some of `RcvConfig`'s fields."""

# Fields that cannot be set, and where their values come from.
DERIVED = {
    "orientation": "follows from the rotation: settings.rotation of the project, or --rotation",
    "box_kind": "follows from the boxes that the pseudo-view detector was trained on",
    "class_agnostic": "follows from the pseudo-view detector",
    "trained": "follows from the pseudo-view detector",
    "image_box_kind": "follows from the boxes on the image",
    "reviewed_sizes": "follows from the reviewed boxes of the project; set typical_sizes",
}


class _File(RootModel[dict[str, JsonValue]]):
    """The content of a settings file before its fields are checked."""


def rcv_config(
    project: Project,
    file: Path | None = None,
    options: Settings | None = None,
    *,
    view_px: int | None = None,
    without_frames: Collection[int] = (),
) -> RcvConfig:
    """Returns the settings for the recursion and for drawing its pseudo-views in a project.

    Args:
        file: JSON with some of the fields; overrides `settings.rcv` of `project.json`.
        options: from the command line; override both.
        view_px: size of pseudo-views if no setting gives one, pixels; None = the size that the project's view detector
            was trained at, or the default without a detector.
        without_frames: ids of frames whose reviewed boxes do not count for the typical sizes of classes.
    """
    # each source is checked on its own, so that the error names the place to correct
    merged = _checked(project.config.settings.rcv, f"{project.path / CONFIG_FILE}: settings.rcv.")
    if file is not None:
        merged |= _checked(read_model(file, _File).root, f"{file}: ")
    config = _validated(merged | _checked(options or {}, "command line: "))
    config = config.model_copy(update={"reviewed_sizes": reviewed_sizes(project, without_frames)})
    if "view_px" in config.model_fields_set:
        return config
    return config.model_copy(update={"view_px": view_px or _trained_px(project) or config.view_px})


def checked_config(settings: Settings) -> RcvConfig:
    """Returns the default settings with these values replaced."""
    return _validated(_checked(settings, "settings."))


def _trained_px(project: Project) -> int | None:
    """Returns the image size of the project's pseudo-view detector; None without a readable one.

    An unreadable detector is reported when it is loaded.
    """
    model = project.models.active(DetectorKind.VIEW)
    if model is None:
        return None
    try:
        return read_trained(model.path.parent).image_size_px
    except FormatError:
        return None


def editable(config: RcvConfig) -> str:
    return json.dumps(config.model_dump(mode="json", exclude=set(DERIVED)), indent=2)


def _checked(settings: Settings, place: str) -> dict[str, Any]:
    for name, reason in DERIVED.items():
        if name in settings:
            raise ConfigError(f"{place}{name}: cannot be set: it {reason}")
    try:
        _validated(settings)
    except ValidationError as error:
        raise ConfigError(place + _message(error.errors()[0])) from error
    return dict(settings)


def _validated(settings: Settings) -> RcvConfig:
    # strict JSON rules: enums are strings, and a number in quotes is an error
    return RcvConfig.model_validate_json(json.dumps(settings), strict=True)


def _message(problem: ErrorDetails) -> str:
    where = ".".join(map(str, problem["loc"]))
    if problem["type"] != "extra_forbidden":
        return f"{where}: {problem['msg'].replace('Input should be', 'must be')}, not {problem['input']!r}"
    # the only settings with parts are typical sizes
    model = RcvConfig if len(problem["loc"]) == 1 else TypicalSize
    known = [name for name in model.model_fields if name not in DERIVED]
    hint = alternatives(str(problem["loc"][-1]), known)
    return f"{where}: there is no such setting; {hint} (`annotator annotate PROJECT --show-config` prints all)"
