"""The command `annotator`: finds the subcommand, runs it and reports its errors.

Only the standard library is imported at the top, so that `annotator --help` is fast.
"""

from __future__ import annotations

import inspect
import os
import re
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

from annotator import __version__


class Command(NamedTuple):
    """A plain function of `annotator.cli`, "module:function", that returns None or an exit code; its line in the help.

    tyro builds the command line from its signature and docstring.
    """

    target: str
    summary: str


# A name of two words is a command of a group.
COMMANDS: dict[str, Command] = {
    "new": Command("project:run_new", "create a project"),
    "add": Command("add:run", "add recordings to a project"),
    "inspect": Command("inspect:run", "show what a recording contains"),
    "import": Command("import_boxes:run", "import 2D or 3D boxes from files"),
    "simulate": Command("annotate:run_simulate", "draw 2D boxes from ground truth with a simulated operator"),
    "views": Command("annotate:run_views", "write pseudo-views as images, to be labelled in another tool"),
    "train": Command("train:run", "train the two 2D detectors"),
    "annotate": Command("annotate:run_annotate", "propose oriented 3D boxes"),
    "lift": Command("annotate:run_lift", "propose oriented 3D boxes from 2D boxes, without training"),
    "track": Command("tracks:run_track", "link the boxes of each object into tracks"),
    "follow": Command("tracks:run_follow", "follow reviewed boxes through a recording"),
    "export": Command("export:run", "write the labels as a dataset"),
    "evaluate": Command("evaluate:run", "score boxes against ground truth, by a benchmark's protocol"),
    "stats": Command("stats:run", "show a project's progress"),
    "serve": Command("serve:serve", "start the workbench, a web page to draw and review boxes"),
    "live": Command("serve:live", "detect on a camera or on a recording as it plays, and show the boxes"),
    "check": Command("check:run", "find errors in a dataset, or suspicious labels in a project"),
    "up": Command("adjust:run_up", "show or set which way is up in a recording"),
    "calibrate": Command("adjust:run_calibrate", "show or correct where clouds lie relative to images"),
    "poses": Command("adjust:run_poses", "show or estimate where the camera of a recording was"),
    "project move": Command("project:run_move", "set the new path of a moved recording"),
    "project remove": Command("project:run_remove", "remove a recording, or a whole project"),
    "project undo": Command("project:run_undo", "undo the last action, such as a run of annotate"),
    "project rename": Command("project:run_rename", "rename a project"),
    "project backup": Command("project:run_backup", "write a backup, also while a server runs"),
    "project restore": Command("project:run_restore", "make a project of a backup"),
    "project verify": Command("project:run_verify", "check whether a project is sound"),
    "project repair": Command("project:run_repair", "make a new project of what is readable"),
    "project copy": Command("project:run_copy", "copy a project, or take in one that somebody else has sent"),
    "classes list": Command("classes:show", "list classes, numbers of their boxes, and attributes"),
    "classes add": Command("classes:add", "add a class"),
    "classes rename": Command("classes:rename", "rename a class; its boxes follow"),
    "classes merge": Command("classes:merge", "give the boxes of classes to another class"),
    "classes remove": Command("classes:remove", "remove a class"),
    "classes order": Command("classes:order", "set the order of the classes"),
    "classes style": Command("classes:style", "set the colour and the key of a class"),
    "classes attribute": Command("classes:attribute", "add or change an attribute"),
    "classes rename-attribute": Command("classes:rename_attribute", "rename an attribute or a choice"),
    "classes order-attributes": Command("classes:order_attributes", "set the order of the attributes"),
    "classes remove-attribute": Command("classes:remove_attribute", "remove an attribute"),
    "tracks class": Command("tracks:set_class", "give all boxes of a track a class"),
    "tracks number": Command("tracks:set_number", "split a track, or merge it into another one"),
    "tracks size": Command("tracks:set_size", "give all boxes of a track one size"),
    "tracks values": Command("tracks:set_values", "set values of attributes of all boxes of a track"),
    "tracks delete": Command("tracks:delete", "remove the boxes of a track, or of a span of it"),
    "tracks fill": Command("tracks:fill", "fill the frames between a track's boxes"),
    "tracks still": Command("tracks:still", "say that tracks stand still: one box in the world for all frames"),
    "tracks moving": Command("tracks:moving", "say that a track moves: a box in each frame again"),
    "generate": Command("demo:generate", "generate a synthetic recording with ground truth"),
    "doctor": Command("doctor:run", "report packages, devices and detector backends, and run a self-test"),
    "demo": Command("demo:demo", "run the whole loop on a generated recording"),
    "completion": Command("completion:run", "print a shell's completion script"),
}

GROUPS: dict[str, str] = {
    "project": "manage a project as a whole",
    "classes": "show and change the classes and attributes of a project",
    "tracks": "change whole tracks, or spans of them; each is one undo step",
}
"""First words of the two-word commands, and their summaries in `annotator --help`."""

USAGE_ERROR = 2
INTERNAL_ERROR = 1
INTERRUPTED = 128 + 2
BROKEN_PIPE = 128 + 13

HELP = """\
usage: annotator COMMAND ... [--debug]

Semi-automatic 3D annotation: a few 2D boxes in, fully oriented 3D boxes out.

commands:
{commands}

options:
  -h, --help  show this help; `annotator help COMMAND` explains a command
  --version   show the version
  --debug     show the traceback of an error

Projects are in ./projects, or in the folder given by --projects or by the variable ANNOTATOR_PROJECTS.
"""

GROUP_HELP = """\
usage: annotator {group} COMMAND ...

{summary}

commands:
{commands}

`annotator help {group} COMMAND` explains a command.
"""

HELP_FLAGS = ("-h", "--help")
# Defaults that the help does not show, as tyro writes them: None, False and ().
NO_DEFAULT = ("None", "False", "")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command line and returns the exit code: 0 done, 1 failed, 2 unusable input, 130 interrupted.

    Args:
        arguments: without the program's name; None = those of this process.
    """
    words, debug = _without_debug(list(sys.argv[1:] if arguments is None else arguments))
    try:
        code = _dispatch(words)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        if debug:
            raise
        sys.stderr.write("interrupted\n")
        return INTERRUPTED
    except BrokenPipeError:
        # the reader has closed the pipe (`| head`); flushing the rest at exit must not fail again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:
        if debug:
            raise
        return _report(error)


def _without_debug(words: list[str]) -> tuple[list[str], bool]:
    """The words without `--debug`, and whether it was there; it may stand anywhere before a bare `--`."""
    end = words.index("--") if "--" in words else len(words)
    others = [word for word in words[:end] if word != "--debug"]
    return others + words[end:], len(others) < end


def _dispatch(words: list[str]) -> int:
    if words[:1] == ["help"]:
        words = [*words[1:], "--help"]
    if not words or words[0] in HELP_FLAGS:
        sys.stdout.write(_help())
        return 0 if words else USAGE_ERROR
    if words[0] == "--version":
        sys.stdout.write(f"annotator {__version__}\n")
        return 0
    if words[0] in GROUPS and (len(words) == 1 or words[1] in HELP_FLAGS):
        sys.stdout.write(_group_help(words[0]))
        return 0 if len(words) > 1 else USAGE_ERROR
    length = 2 if words[0] in GROUPS else 1
    name, rest = " ".join(words[:length]), words[length:]
    if name not in COMMANDS:
        raise _unusable(_unknown_command(name))
    before = rest[: rest.index("--") if "--" in rest else None]
    options = [word.partition("=")[0] for word in before if word.startswith("--")]
    for option in options:
        # tyro would use the last one only, and not say so
        if options.count(option) > 1:
            raise _unusable(f"{option} is given twice; give it once, with all its values: {option} A B")
    import tyro

    # tyro itself exits for --help (0) and for an invalid command line (2)
    command = with_help(load(COMMANDS[name]))
    result: int | None = tyro.cli(command, prog=f"annotator {name}", args=rest, config=style())
    return result or 0


def _unusable(message: str) -> Exception:
    from annotator.types.errors import ConfigError

    return ConfigError(message)


def _help() -> str:
    rows: dict[str, str] = {}
    for name, command in COMMANDS.items():
        group, _, member = name.partition(" ")
        rows[group] = f"{GROUPS[group]}: see `annotator help {group}`" if member else command.summary
    return HELP.format(commands=_columns(rows))


def _group_help(group: str) -> str:
    members = {name.partition(" ")[2]: row.summary for name, row in COMMANDS.items() if name.startswith(f"{group} ")}
    summary = f"{GROUPS[group].capitalize()}."
    return GROUP_HELP.format(group=group, summary=summary, commands=_columns(members))


def _columns(rows: dict[str, str]) -> str:
    width = max(map(len, rows))
    return "\n".join(f"  {name:{width}}  {summary}" for name, summary in rows.items())


def _unknown_command(name: str) -> str:
    group, _, member = name.partition(" ")
    known = [known for known in COMMANDS if not member or known.startswith(f"{group} ")]
    near = get_close_matches(name, known, 1)
    meant = f"did you mean {near[0]!r}?" if near else f"the commands are {', '.join(known)}"
    return f"unknown command {name!r}; {meant}"


def load(command: Command) -> Callable[..., int | None]:
    module, _, function = command.target.partition(":")
    target: Callable[..., int | None] = getattr(import_module(f"annotator.cli.{module}"), function)
    return target


def with_help(function: Callable[..., int | None]) -> Callable[..., int | None]:
    """The function as tyro gets it: one that takes a project, or its folder, gets it by its name and `--projects`.

    Annotations and docstring give a shorter help: defaults of None, False and () are not shown, and the lines of an
    argument's description are joined.
    """
    from tyro.conf import arg

    from annotator.cli.options import ProjectName, Projects, named_folder, open_named

    def command(*values: Any, **options: Any) -> int | None:
        if not by_name:
            return function(*values, **options)
        name, root = values[0], options.pop("projects")
        if kind is Path:
            return function(named_folder(name, root), *values[1:], **options)
        with open_named(name, root) as project:
            return function(project, *values[1:], **options)

    # the tests decorate every function; without this, tyro would read the undecorated one
    vars(command).pop("__wrapped__", None)
    hint = arg(help_behavior_hint=lambda default: "" if default in NO_DEFAULT else f"(default: {default})")
    annotations, signature = get_type_hints(function, include_extras=True), inspect.signature(function)
    # in other commands, `project` is only a name
    by_name = isinstance(kind := annotations.get("project"), type)
    if by_name:
        annotations |= {"project": ProjectName, "projects": Projects}
        option = inspect.Parameter("projects", inspect.Parameter.KEYWORD_ONLY, default=None)
        signature = signature.replace(parameters=[*signature.parameters.values(), option])
    for name, annotation in annotations.items():
        if all(getattr(each, "help_behavior_hint", None) is None for each in getattr(annotation, "__metadata__", ())):
            annotations[name] = Annotated[annotation, hint]
    command.__annotations__ = annotations
    command.__signature__ = signature  # type: ignore[attr-defined]
    command.__doc__ = re.sub(r"\n {8,}", " ", inspect.getdoc(function) or "")
    return command


def style() -> tuple[Any, ...]:
    """How tyro builds the command lines: flags without a `--no-` form, choices by enum value, no `None` as a value."""
    from tyro import conf

    return (conf.FlagCreatePairsOff, conf.EnumChoicesFromValues, conf.DisallowNone, conf.PositionalMetavarFromFieldName)


def _report(error: Exception) -> int:
    """Writes the error to standard error, in red on a terminal; returns the exit code."""
    from rich.console import Console
    from rich.text import Text

    from annotator.types.errors import AnnotatorError

    if isinstance(error, AnnotatorError):
        message, code = str(error), USAGE_ERROR
    else:
        message = f"{type(error).__name__}: {error}\nthis is a bug in annotator; --debug shows the traceback"
        code = INTERNAL_ERROR
    Console(stderr=True).print(Text(f"error: {message}", style="red"), soft_wrap=True)
    return code
