"""The report of `annotator doctor`: lines with the state ok, warning or failed, as JSON and as plain text."""

from __future__ import annotations

import os
from collections.abc import Iterator
from enum import StrEnum
from itertools import groupby
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

REPORT_VERSION = 1
# Shorter home folders, such as "/" or "/a", are not replaced: they occur in many unrelated paths.
SHORTEST_HOME = 4


class State(StrEnum):
    """The state of a line. A missing optional package is ok; FAILED means that something does not work."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


class Line(BaseModel):
    """The result of one check.

    Attributes:
        section: section of the report, such as "machine" or "self-test".
        name: unique within its section.
        state: ok, warning or failed.
        found: the result in words.
        remedy: what the user should do; "" if nothing.
        figures: measured values by name; the name includes the unit.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    section: str
    name: str
    state: State
    found: str
    remedy: str = ""
    figures: dict[str, float] = Field(default_factory=dict)


class Report(BaseModel):
    """All lines of a run.

    Attributes:
        report_version: version of this schema.
        annotator_version: version of annotator that was checked.
        lines: the lines, grouped by section.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    report_version: int = REPORT_VERSION
    annotator_version: str
    lines: tuple[Line, ...]

    @property
    def failed(self) -> bool:
        """Whether any line has failed."""
        return any(line.state is State.FAILED for line in self.lines)


def without_home(line: Line) -> Line:
    """Replaces the user's home folder in a line by `~`, so that the report does not contain the user's name."""
    return line.model_copy(update={"found": shortened(line.found), "remedy": shortened(line.remedy)})


def shortened(text: str) -> str:
    """Replaces the user's home folder in a text by `~`."""
    home = Path.home()
    for path in {str(home), str(home.resolve())}:
        if len(path) >= SHORTEST_HOME:
            text = text.replace(path + os.sep, "~" + os.sep)
            text = "~" if text == path else text
    return text


def as_text(report: Report) -> Iterator[str]:
    """Yields the report as lines of plain text."""
    yield f"annotator {report.annotator_version}"
    width = max((len(line.name) for line in report.lines), default=0)
    for section, lines in groupby(report.lines, lambda line: line.section):
        yield ""
        yield f"{section}:"
        for line in lines:
            yield f"  {line.name:{width}}  {line.found}: {line.state.value}"
            if line.remedy:
                yield f"  {'':{width}}    -> {line.remedy}"
    counts = {state: sum(line.state is state for line in report.lines) for state in State}
    yield ""
    yield ", ".join(f"{count} {state.value}" for state, count in counts.items())
