"""What a check has found, collected so that a file of a million faults does not fill the memory."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.types.errors import AnnotatorError
from annotator.workflows.checking.rules import Rule, Severity

MOST_A_FILE = 20
# About 20 MB; what comes again after so many different findings counts again.
MOST_KNOWN = 200_000


class Finding(BaseModel):
    """One finding.

    Attributes:
        file: the file (or folder) that it is about, below the path that was checked.
        line: 1-based, where the file has lines.
        frame: key of the frame, where it is about one.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rule: str
    severity: Severity
    file: str
    line: int | None
    frame: str | None
    message: str

    @property
    def place(self) -> str:
        """`file`, or `file:line`."""
        return self.file if self.line is None else f"{self.file}:{self.line}"


class Findings:
    """Collects findings; the same one twice counts once, and of a rule `MOST_A_FILE` a file are kept in full."""

    def __init__(self) -> None:
        self._found: list[Finding] = []
        # hashes, since the messages of those that are not kept would fill the memory
        self._seen: set[int] = set()
        self._counts: Counter[tuple[Rule, str]] = Counter()

    def add(self, rule: Rule, file: Path, message: str, *, line: int | None = None, frame: str | None = None) -> None:
        """Notes a breach of a rule."""
        # without the frame: a file that many frames share is faulty once
        same = hash((rule, str(file), line, message))
        if same in self._seen:
            return
        if len(self._seen) < MOST_KNOWN:
            self._seen.add(same)
        self._counts[rule, str(file)] += 1
        if self._counts[rule, str(file)] <= MOST_A_FILE:
            self._found.append(_finding(rule, str(file), message, line, frame))

    def add_error(self, rule: Rule, error: AnnotatorError, file: Path, *, frame: str | None = None) -> None:
        """Notes an error that says file and line by itself; `file` is for one that does not."""
        named = getattr(error, "path", None)
        place = named if isinstance(named, Path) else file
        line = getattr(error, "line", None)
        message = str(error).removeprefix(str(place))
        message = message.removeprefix(f":{line}").removeprefix(": ")
        self.add(rule, place, message, line=line, frame=frame)

    def counts(self) -> dict[Severity, int]:
        """How many breaches of each severity were found, those that are not kept included."""
        return {
            each: sum(count for (rule, _), count in self._counts.items() if rule.severity is each) for each in Severity
        }

    def all(self) -> tuple[Finding, ...]:
        """All that was found, by file and line; what was not kept of a file is counted in a last row."""
        more = [
            _finding(rule, file, f"and {count - MOST_A_FILE} more like this in this file", None, None)
            for (rule, file), count in self._counts.items()
            if count > MOST_A_FILE
        ]
        # sorting keeps the order of what is equal, so that the counts come last
        return tuple(sorted([*self._found, *more], key=lambda f: (f.file, f.line is None, f.line or 0)))


def _finding(rule: Rule, file: str, message: str, line: int | None, frame: str | None) -> Finding:
    return Finding(rule=rule.id, severity=rule.severity, file=file, line=line, frame=frame, message=message)
