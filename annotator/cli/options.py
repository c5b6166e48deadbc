"""Options and arguments that several commands share: one name, meaning and help text each; the project they name."""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from tyro import conf
from tyro.conf import arg

from annotator.project import Project, list_projects, open_project
from annotator.project.config import CONFIG_FILE, check_name
from annotator.recordings.recording import ReaderOptions, parse_options
from annotator.types.errors import ConfigError
from annotator.types.messages import alternatives
from annotator.workflows.add_recordings import ALL

Value = TypeVar("Value")

ProjectName = Annotated[str, arg(help="name of the project.")]
RecordingName = Annotated[str, arg(help="name of the recording in the project.")]
RecordingNames = Annotated[tuple[str, ...], arg(help="names of the project's recordings; default: all.")]

Projects = Annotated[
    Path | None,
    arg(
        metavar="DIR",
        help="folder of projects; default: the variable ANNOTATOR_PROJECTS, else ./projects.",
    ),
]
AsJson = Annotated[bool, arg(name="json", help="print one JSON object.")]
Seed = Annotated[int, arg(help="seed of the random choices, 0 or more.")]
Clear = Annotated[bool, arg(help="remove what the project has set: the recording's files decide again.")]
ModelsOption = Annotated[Value, arg(help="detectors to include: all, those in use (active), or none.")]
Yes = Annotated[bool, arg(help="do it without asking.")]
Limit = Annotated[int | None, arg(help="stop after this many frames; default: no limit.")]

BoxKindOption = Annotated[
    Value,
    arg(
        name="box-kind",
        help="what the 2D boxes enclose: silhouette = the visible part of the object, box = its projected 3D box.",
    ),
]
# The type of these differs between commands, so each command gives it: Rotation[BoxRotation].
Rotation = Annotated[
    Value,
    arg(help="rotation of the boxes: upright, free, or auto (upright if gravity is known, else free)."),
]
BackendOption = Annotated[
    Value,
    arg(
        help="inference backend of the detectors: auto = the fastest of those that give the same boxes as torch; "
        "fastest = the fastest of all, in half precision if the processor supports it."
    ),
]

Host = Annotated[str, arg(help="address to listen on; by default, only this computer can reach it.")]
Port = Annotated[int, arg(help="port to listen on; 0 picks a free one.")]
TokenFile = Annotated[
    Path | None,
    arg(
        metavar="FILE",
        help="file with the token that browsers must present, readable for its owner only; default: the variable "
        "ANNOTATOR_TOKEN, else a new token in the printed link.",
    ),
]
NoToken = Annotated[
    bool, arg(help="ask for no token: every user and program of this computer may use the page; not with --host.")
]


def ids_of(project: Project, names: tuple[str, ...]) -> tuple[int, ...] | None:
    """The ids of recordings by their names; None without any, which stands for all."""
    return tuple(project.recordings.find(name).id for name in names) or None


def names_in(given: tuple[str, ...], known: Collection[str] = ()) -> tuple[str, ...]:
    """The names that an option has: each word is one, or several with commas between them.

    Args:
        given: the words of the command line.
        known: names that stay whole even if they contain a comma.
    """
    split = [[word] if word in known else [each.strip() for each in word.split(",") if each.strip()] for word in given]
    # an empty word is refused where it is used, as any other name
    return tuple(name for word, names in zip(given, split, strict=True) for name in names or [word])


ENVIRONMENT = "ANNOTATOR_PROJECTS"
DEFAULT_ROOT = Path("projects")


def projects_root(projects: Path | None) -> Path:
    """The folder of projects: as given, else ANNOTATOR_PROJECTS, else `projects` in the current folder."""
    if projects is not None:
        return projects
    return Path(os.environ.get(ENVIRONMENT) or DEFAULT_ROOT)


def open_named(name: str, projects: Path | None) -> Project:
    return open_project(named_folder(name, projects))


def named_folder(name: str, projects: Path | None) -> Path:
    """The folder of the project of this name, which may be damaged."""
    folder = projects_root(projects)
    try:
        check_name(name)
    except ConfigError as error:
        if len(Path(name).parts) != 1:
            raise ConfigError(f"{error}; --projects names the folder of projects") from error
        raise ConfigError(no_project(name, folder)) from error
    if not (folder / name).is_dir():
        raise ConfigError(
            f"{no_project(name, folder)}; `annotator new` creates one, and --projects names another folder"
        )
    return folder / name


def place_of(what: str, projects: Path | None) -> tuple[Path, bool]:
    """The project of this name, or the path, and whether it is a project. `./NAME` is a path, and a project has one."""
    path, root = Path(what), projects_root(projects)
    named = root / what if len(path.parts) == 1 and not what.startswith(".") else path
    if named is not path and named.is_dir():
        if path.exists() and not path.samefile(named):
            raise ConfigError(f"{what} is both a path and a project; write ./{what} or {named}")
        return named, True
    if named is not path and not path.exists():
        raise ConfigError(f"{what}: no such file or folder, and {no_project(what, root)}")
    return path, (path / CONFIG_FILE).is_file()


def no_project(name: str, folder: Path) -> str:
    """Says that a folder of projects has none of this name, and which is probably meant."""
    others = alternatives(name, [each.path.name for each in list_projects(folder)])
    return f"{folder} has no project {name!r} ({others})"


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
        """The options as readers take them, of one scene and one camera."""
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
