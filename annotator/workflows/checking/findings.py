"""Collects the findings of a check, with limited memory for files with very many faults."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.types.errors import AnnotatorError
from annotator.workflows.checking.rules import Rule, Severity

MOST_A_FILE = 20
# Findings beyond this number (about 20 MB) are no longer checked for repetitions.
MOST_KNOWN = 200_000


class Finding(BaseModel):
    """One finding.

    Attributes:
        file: the file (or folder) with the problem.
        line: 1-based line number; None if the file has no lines.
        frame: key of the frame; None for a whole dataset.
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
    """Collects findings: equal ones count once, and `MOST_A_FILE` per rule and file are kept in full."""

    def __init__(self) -> None:
        self._findings: list[Finding] = []
        # hashes of all findings, which need less memory than their messages
        self._seen: set[int] = set()
        self._counts: Counter[tuple[Rule, str]] = Counter()

    def add(self, rule: Rule, file: Path, message: str, *, line: int | None = None, frame: str | None = None) -> None:
        """Adds a breach of a rule."""
        # without the frame: a shared file is faulty once, not once per frame
        fingerprint = hash((rule, str(file), line, message))
        if fingerprint in self._seen:
            return
        if len(self._seen) < MOST_KNOWN:
            self._seen.add(fingerprint)
        self._counts[rule, str(file)] += 1
        if self._counts[rule, str(file)] <= MOST_A_FILE:
            self._findings.append(_finding(rule, str(file), message, line, frame))

    def add_error(self, rule: Rule, error: AnnotatorError, file: Path, *, frame: str | None = None) -> None:
        """Adds an error with its own file and line; `file` is used if it has none."""
        error_path = getattr(error, "path", None)
        place = error_path if isinstance(error_path, Path) else file
        line = getattr(error, "line", None)
        message = str(error).removeprefix(str(place))
        message = message.removeprefix(f":{line}").removeprefix(": ")
        self.add(rule, place, message, line=line, frame=frame)

    def counts(self) -> dict[Severity, int]:
        """Returns the number of breaches of each severity, including those that are not kept."""
        return {
            each: sum(count for (rule, _), count in self._counts.items() if rule.severity is each) for each in Severity
        }

    def by_rule(self) -> dict[str, int]:
        """Returns the number of breaches of each rule that was breached, as `counts`."""
        total: Counter[str] = Counter()
        for (rule, _), count in self._counts.items():
            total[rule.id] += count
        return dict(sorted(total.items()))

    def all(self) -> tuple[Finding, ...]:
        """Returns all findings by file and line; the last row of a file counts those that are not kept."""
        more = [
            _finding(rule, file, f"and {count - MOST_A_FILE} more like this in this file", None, None)
            for (rule, file), count in self._counts.items()
            if count > MOST_A_FILE
        ]
        # sorting is stable, so the counts come last
        return tuple(sorted([*self._findings, *more], key=lambda f: (f.file, f.line is None, f.line or 0)))


def _finding(rule: Rule, file: str, message: str, line: int | None, frame: str | None) -> Finding:
    return Finding(rule=rule.id, severity=rule.severity, file=file, line=line, frame=frame, message=message)
