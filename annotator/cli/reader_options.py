"""The options of recordings' readers, for the commands that open recordings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from tyro import conf

from annotator.recordings.recording import ReaderOptions, parse_options
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import ALL


def option(name: str, metavar: str | None = None) -> object:
    """Describes an option as `ReaderOptions` does. None is not shown as the default, as in other commands."""
    text = f"{ReaderOptions.model_fields[name].description}."
    return conf.arg(metavar=metavar, help=text, help_behavior_hint="")


@dataclass(frozen=True)
class ReadAs:
    """How the recording is read; each format takes its own options, and by default decides by its files."""

    columns: Annotated[int | None, option("columns")] = None
    scene: Annotated[tuple[str, ...], option("scene", "NAME ...")] = ()
    camera: Annotated[tuple[str, ...], option("camera", "NAME ...")] = ()
    look_around: Annotated[Literal[4, 6, 8] | None, option("look_around")] = None
    origin: Annotated[tuple[float, float, float] | None, option("origin", "X Y Z")] = None
    image: Annotated[str | None, option("image", "TOPIC")] = None
    points: Annotated[str | None, option("points", "TOPIC")] = None
    depth: Annotated[str | None, option("depth", "TOPIC")] = None
    camera_info: Annotated[str | None, option("camera_info", "TOPIC")] = None
    depth_info: Annotated[str | None, option("depth_info", "TOPIC")] = None
    frame: Annotated[str | None, option("tf_frame")] = None
    no_motion: Annotated[bool, option("no_motion")] = False
    tolerance: Annotated[float | None, option("tolerance_s")] = None
    min_confidence: Annotated[int | None, option("min_confidence")] = None

    def options(self) -> ReaderOptions:
        """The options as readers take them, of one scene and one camera.

        Raises:
            ConfigError: an invalid value.
        """
        given = asdict(self)
        for name in ("scene", "camera"):
            given[name] = _only(name, given[name])
        renamed = {"tf_frame": given.pop("frame"), "tolerance_s": given.pop("tolerance")}
        return parse_options(no_motion=given.pop("no_motion") or None, **renamed, **given)


def _only(name: str, given: tuple[str, ...]) -> str | None:
    if len(given) > 1 or given == (ALL,):
        raise ConfigError(f"--{name} {' '.join(given)}: name one {name}")
    return next(iter(given), None)


Reading = Annotated[ReadAs, conf.arg(name="")]
AS_FILES_SAY = ReadAs()
