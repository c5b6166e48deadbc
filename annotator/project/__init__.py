"""What is kept: the project folder, its SQLite store, migrations, label events."""

from annotator.project.boxes import ImageBoxes, ViewBoxes
from annotator.project.config import BoxRotation, ProjectConfig, ProjectSettings
from annotator.project.events import Effort, Event
from annotator.project.frames import StoredFrame
from annotator.project.history import Done, History
from annotator.project.jobs import FrameResult, Run, Status, run_key
from annotator.project.labels import REVIEWED, LabelSignals, NewLabel, StoredLabel
from annotator.project.models import Role, StoredModel
from annotator.project.payloads import Origin
from annotator.project.project import (
    FrameState,
    ListedProject,
    Project,
    create_project,
    list_projects,
    open_project,
)
from annotator.project.proposals import Pass, PassObject, Replaced, RunShare
from annotator.project.recordings import Move, Rescan, StoredRecording
from annotator.project.records import ViewGeometry
from annotator.project.statistics import Statistics
from annotator.project.writing import Change, FramePart, Receipt

__all__ = [
    "REVIEWED",
    "BoxRotation",
    "Change",
    "Done",
    "Effort",
    "Event",
    "FramePart",
    "FrameResult",
    "FrameState",
    "History",
    "ImageBoxes",
    "LabelSignals",
    "ListedProject",
    "Move",
    "NewLabel",
    "Origin",
    "Pass",
    "PassObject",
    "Project",
    "ProjectConfig",
    "ProjectSettings",
    "Receipt",
    "Replaced",
    "Rescan",
    "Role",
    "Run",
    "RunShare",
    "Statistics",
    "Status",
    "StoredFrame",
    "StoredLabel",
    "StoredModel",
    "StoredRecording",
    "ViewBoxes",
    "ViewGeometry",
    "create_project",
    "list_projects",
    "open_project",
    "run_key",
]
