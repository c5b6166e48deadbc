"""Options and arguments that several commands share: one name, one meaning and one help text for each."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, TypeVar

from tyro.conf import arg

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


def names_in(given: tuple[str, ...], known: Collection[str] = ()) -> tuple[str, ...]:
    """The names that an option has: each word is one, or several with commas between them.

    Args:
        given: the words of the command line.
        known: names that stay whole even if they contain a comma.
    """

    def split() -> Iterator[str]:
        for word in given:
            names = [] if word in known else [name.strip() for name in word.split(",") if name.strip()]
            # an empty word is refused where it is used, as any other name
            yield from names or [word]

    return tuple(split())
