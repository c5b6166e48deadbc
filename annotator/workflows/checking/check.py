"""`annotator check PATH`: checks the datasets at a path."""

from __future__ import annotations

from pathlib import Path

from pydantic import BaseModel, ConfigDict

from annotator.types.errors import FormatError
from annotator.workflows.checking.box_sets import report_sizes, rule_of
from annotator.workflows.checking.dataset_check import DatasetCheck, DatasetFacts, Progress
from annotator.workflows.checking.findings import Finding, Findings
from annotator.workflows.checking.other_software import OtherSoftwareDataset
from annotator.workflows.checking.rules import (
    UNCHECKED_DATASET,
    UNREADABLE_DATASET,
    Severity,
)
from annotator.workflows.checking.sources import find_sources
from annotator.workflows.importing.size_doubts import SizeDoubts


class DatasetReport(BaseModel):
    """The findings by file and line, and the number of each severity and rule, including those that are not listed."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    datasets: tuple[DatasetFacts, ...]
    findings: tuple[Finding, ...]
    counts: dict[Severity, int]
    by_rule: dict[str, int]


def check_datasets(path: Path, progress: Progress | None = None) -> DatasetReport:
    """Checks every dataset at or below a path.

    Args:
        progress: called with (frames checked, frames of this dataset).

    Raises:
        RecordingError: there is no dataset.
    """
    findings, facts = Findings(), []
    for source in find_sources(path):
        if isinstance(source, tuple):
            findings.add_error(UNREADABLE_DATASET, source[1], source[0])
        elif isinstance(source, OtherSoftwareDataset):
            facts += _read_other_software(source, findings)
        else:
            facts.append(DatasetCheck(source, findings).run(progress))
    return DatasetReport(
        datasets=tuple(facts), findings=findings.all(), counts=findings.counts(), by_rule=findings.by_rule()
    )


def _read_other_software(dataset: OtherSoftwareDataset, findings: Findings) -> list[DatasetFacts]:
    """Reads a dataset of other software; returns no facts if a part of it cannot be read."""
    frames = labels = faults = 0
    sizes = SizeDoubts()

    def on_fault(fault: FormatError) -> None:
        nonlocal faults
        findings.add_error(rule_of(fault), fault, dataset.path)
        faults += 1

    for part in dataset.parts(on_fault):
        frames, labels = frames + part.frames, labels + part.labels
        for label, size_m in part.sizes:
            sizes.add(label, size_m)
    if faults:
        return []
    report_sizes(sizes, findings, dataset.path)
    findings.add(
        UNCHECKED_DATASET,
        dataset.path,
        f"{dataset.format}: read, but their boxes are not compared with clouds and images",
    )
    return [DatasetFacts(path=str(dataset.path), format=dataset.format, frames=frames, labels=labels)]
