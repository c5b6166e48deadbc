"""What a local worker is told at first, and what it says where it cannot begin."""

from __future__ import annotations

import traceback
from dataclasses import dataclass

from annotator.types.errors import AnnotatorError
from annotator.workflows.engines.sources import DetectorSource
from annotator.workflows.engines.storage import Storage


@dataclass(frozen=True, eq=False)
class Start:
    """What a worker needs to begin.

    Attributes:
        source: of its detectors.
        threads: of the processor that it may use; None: all cores.
        storage: where it reads recordings.
    """

    source: DetectorSource
    threads: int | None
    storage: Storage


@dataclass(frozen=True)
class Fault:
    """Why a worker cannot begin.

    Attributes:
        is_fault: of the program; the reason is a traceback then.
    """

    reason: str
    is_fault: bool


def fault_of(error: Exception) -> Fault:
    """What is said of an error on the way to the first task."""
    if isinstance(error, AnnotatorError):
        return Fault(str(error), False)
    return Fault("".join(traceback.format_exception(error)), True)
