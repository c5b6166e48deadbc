"""The options of recordings' readers, for the commands that open recordings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from typing import Annotated, Literal

from tyro import conf

from annotator.recordings.options import ReaderOptions, parse_options
from annotator.types.errors import ConfigError
from annotator.workflows.add_recordings import ALL

# None is not shown as the default, as in other commands
option = partial(conf.arg, help_behavior_hint="")


@dataclass(frozen=True)
class ReadAs:
    """How the recording is read; each format takes its own options, and by default decides by its files."""

    columns: Annotated[int | None, option(help="numbers per point in .bin files.")] = None
    scene: Annotated[tuple[str, ...], option(metavar="NAME ...", help="scenes of a dataset; all = all of them.")] = ()
    camera: Annotated[tuple[str, ...], option(metavar="NAME ...", help="cameras of a rig; all = all of them.")] = ()
    look_around: Annotated[
        Literal[4, 6, 8] | None, option(help="number of virtual cameras around a LiDAR, to label all that it sees.")
    ] = None
    image: Annotated[str | None, option(metavar="TOPIC", help="topic of the camera images in a bag.")] = None
    points: Annotated[str | None, option(metavar="TOPIC", help="topic of the point clouds in a bag.")] = None
    depth: Annotated[str | None, option(metavar="TOPIC", help="topic of the depth images in a bag.")] = None
    camera_info: Annotated[str | None, option(metavar="TOPIC", help="topic of the camera's calibration in a bag.")] = (
        None
    )
    frame: Annotated[str | None, option(help="tf frame of the camera, if not the one that its images name.")] = None
    tolerance: Annotated[
        float | None, option(help="largest difference in time between an image and its points or depth, seconds.")
    ] = None
    min_confidence: Annotated[
        int | None, option(help="lowest confidence of a phone's depth that is used: 0, 1 or 2.")
    ] = None

    def options(self) -> ReaderOptions:
        """The options as readers take them, of one scene and one camera.

        Raises:
            ConfigError: an invalid value.
        """
        given = asdict(self)
        for name in ("scene", "camera"):
            given[name] = _only(name, given[name])
        return parse_options(tf_frame=given.pop("frame"), tolerance_s=given.pop("tolerance"), **given)


def _only(name: str, given: tuple[str, ...]) -> str | None:
    if len(given) > 1 or given == (ALL,):
        raise ConfigError(f"--{name} {' '.join(given)}: name one {name}")
    return next(iter(given), None)


Reading = Annotated[ReadAs, conf.arg(name="")]
AS_FILES_SAY = ReadAs()
