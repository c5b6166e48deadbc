"""The command `annotator`: finds the subcommand, runs it, and is the one place where its errors end.

Only the standard library is imported at the top, so that `annotator --help` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from importlib import import_module
from typing import Any

from annotator import __version__
from annotator.cli.table import COMMANDS, Command

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
  -h, --help  this help; `annotator COMMAND --help` explains a command
  --version   the version
  --debug     show the traceback of an error

Projects live in ./projects, or where --root or the variable ANNOTATOR_PROJECTS says.
"""


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
        # the reader has gone (`| head`); whatever is still buffered must not fail again at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except Exception as error:
        if debug:
            raise
        return _report(error)


def _without_debug(words: list[str]) -> tuple[list[str], bool]:
    """The words without `--debug`, which may stand anywhere before a bare `--`."""
    end = words.index("--") if "--" in words else len(words)
    kept = [word for word in words[:end] if word != "--debug"]
    return kept + words[end:], len(kept) < end


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(_help())
        return 0 if words else USAGE_ERROR
    if words[0] == "--version":
        sys.stdout.write(f"annotator {__version__}\n")
        return 0
    command = COMMANDS.get(words[0])
    if command is None:
        raise _unknown_command(words[0])
    return _run(words[0], command, words[1:])


def _help() -> str:
    width = max(map(len, COMMANDS))
    return HELP.format(commands="\n".join(f"  {name:{width}}  {row.summary}" for name, row in COMMANDS.items()))


def _unknown_command(word: str) -> Exception:
    from annotator.types.errors import ConfigError

    near = get_close_matches(word, COMMANDS, 1)
    meant = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(COMMANDS)}"
    return ConfigError(f"{word!r} is no command of annotator; {meant}")


def _run(name: str, command: Command, words: list[str]) -> int:
    import tyro

    module, _, function = command.target.partition(":")
    target: Callable[..., int | None] = getattr(import_module(module), function)
    # tyro ends the process itself for --help (0) and for a command line that does not fit (2)
    result = tyro.cli(target, prog=f"annotator {name}", args=words, config=_style())
    return result or 0


def _style() -> tuple[Any, ...]:
    """How command lines look: `--flag` alone, choices as they are written on disk, no word for None."""
    from tyro import conf

    return (conf.FlagCreatePairsOff, conf.EnumChoicesFromValues, conf.DisallowNone, conf.PositionalMetavarFromFieldName)


def _report(error: Exception) -> int:
    """Says on standard error what went wrong, in red where that is a terminal; returns the exit code."""
    from rich.console import Console
    from rich.text import Text

    from annotator.types.errors import AnnotatorError

    if isinstance(error, AnnotatorError):
        message, code = str(error), USAGE_ERROR
    else:
        message = f"{type(error).__name__}: {error}\nthis is a fault of annotator; --debug shows where it happened"
        code = INTERNAL_ERROR
    Console(stderr=True).print(Text(f"error: {message}", style="red"), soft_wrap=True)
    return code


if __name__ == "__main__":
    sys.exit(main())
