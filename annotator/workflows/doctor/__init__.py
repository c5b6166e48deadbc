"""Facts about this machine, the backends that detectors use on it, and self-tests of the backends."""

from annotator.workflows.doctor.examine import examine
from annotator.workflows.doctor.report import Line, Report, State, as_text

__all__ = ["Line", "Report", "State", "as_text", "examine"]
