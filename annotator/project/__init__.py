"""Projects: the folder, its SQLite database, migrations and label events."""

from annotator.project.adjustments import Basis
from annotator.project.audit.events import Effort
from annotator.project.audit.history import History, Reverted
from annotator.project.audit.writing import Receipt, WriteContext
from annotator.project.boxes import ImageBoxes, ViewBoxes
from annotator.project.changes import NewLabel, Origin
from annotator.project.config import BoxRotation, ProjectConfig, ProjectSettings
from annotator.project.frames import StoredFrame
from annotator.project.jobs import Status
from annotator.project.labels import MOST_BESIDE, REVIEWED, StoredLabel
from annotator.project.log import FramePart, new_action
from annotator.project.models import StoredModel
from annotator.project.progress.statistics import Statistics
from annotator.project.project import ListedProject, Project, create_project, list_projects, open_project
from annotator.project.proposals import RunShare
from annotator.project.recordings import StoredRecording
from annotator.project.records import ViewGeometry
