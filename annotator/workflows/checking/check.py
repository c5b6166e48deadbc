"""`annotator check PATH`: everything that is wrong with the datasets at a path."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.workflows.checking.dataset_check import DatasetCheck, DatasetFacts, Progress
from annotator.workflows.checking.findings import Finding, Findings
from annotator.workflows.checking.rules import UNCHECKED_DATASET, UNREADABLE_DATASET, Severity
from annotator.workflows.checking.sources import NotChecked, find_sources


class DatasetReport(BaseModel):
    """All findings, by file and line, and how many of each severity."""

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
    found = findings.all()
    counts = Counter(finding.severity for finding in found)
    return DatasetReport(datasets=tuple(facts), findings=found, counts={each: counts[each] for each in Severity})
