"""`annotator check PATH`: everything that is wrong with the datasets at a path."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.workflows.checking.dataset_check import DatasetCheck, DatasetFacts, Progress
from annotator.workflows.checking.findings import Finding, Findings
from annotator.workflows.checking.rules import UNCHECKED_DATASET, UNREADABLE_DATASET, Severity
from annotator.workflows.checking.sources import NotChecked, find_sources


class DatasetReport(BaseModel):
    """The findings by file and line, and how many there are of each severity, those that are only counted included."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    datasets: tuple[DatasetFacts, ...]
    findings: tuple[Finding, ...]
    counts: dict[Severity, int]


def check_datasets(path: Path, progress: Progress | None = None) -> DatasetReport:
    """Checks every dataset at or below a path.

    Args:
        progress: called with (frames looked at, frames of this dataset).

    Raises:
        RecordingError: there is no dataset.
    """
    findings, facts = Findings(), []
    for source in find_sources(path):
        if isinstance(source, tuple):
            findings.add_error(UNREADABLE_DATASET, source[1], source[0])
        elif isinstance(source, NotChecked):
            findings.add(UNCHECKED_DATASET, source.path, f"{source.format} are not looked at")
        else:
            facts.append(DatasetCheck(source, findings).run(progress))
    return DatasetReport(datasets=tuple(facts), findings=findings.all(), counts=findings.counts())
