"""`annotator new`, `annotator project ...`: a project as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from annotator.cli import options
from annotator.cli.output import counted, print_line, print_result, require_yes
from annotator.project import BoxRotation, Project, ProjectSettings, create_project, open_project
from annotator.project.backup.archive import ModelChoice
from annotator.project.backup.make import automatic_backups, back_up
from annotator.project.backup.repair import repair
from annotator.project.backup.take_in import copy_project, restore
from annotator.project.backup.verify import Verification, verify
from annotator.project.config import rename_project, set_aside
from annotator.types.errors import AnnotatorError, ConfigError
from annotator.types.messages import amount, first_few
from annotator.workflows.add_recordings import move_recording


def run_new(
    name: str,
    /,
    *,
    classes: tuple[str, ...],
    rotation: options.Rotation[BoxRotation] = BoxRotation.AUTO,
    projects: options.Projects = None,
) -> None:
    """Create a project.

    Args:
        name: name of the project and of its folder.
        classes: classes to annotate, such as `hand`; several with spaces or commas between them.
    """
    settings = ProjectSettings(rotation=rotation)
    with create_project(options.projects_root(projects), name, options.names_in(classes), settings=settings) as project:
        print_line(f"created {project.path} for {', '.join(project.config.classes)}")
        print_line(f"next: annotator add {name} PATH")


def run_move(project: Project, recording: options.RecordingName, path: Path, /) -> None:
    """Set the new path of a moved recording. All its frames must be at the new path; labels and boxes are kept.

    A recording that was removed comes back with its labels.

    Args:
        path: new path of the recording.
    """
    before = project.recordings.find(recording, removed=True)
    now = move_recording(project, before.id, path)
    new = now.frames - before.frames if before.removed_by is None else 0
    grown = f" ({new} new)" if new > 0 else ""
    print_line(f"{now.name}: {amount(now.frames, 'frame')}{grown}, now at {now.path}")


def run_undo(project: Project, /, *, author: str | None = None, redo: bool = False) -> None:
    """Undo the last action: a whole run of `annotate` or `lift`, a change of the classes, or what was done on the page.

    It is refused where somebody has changed the same since.

    Args:
        author: whose last action; default: the last one of all.
        redo: redo what was undone last.
    """
    history = project.history
    name = author or history.last_author(undone=redo)
    if name is None:
        raise ConfigError(f"{project.path.name} has nothing to {'redo' if redo else 'undo'}")
    done = (history.redo if redo else history.undo)(name)
    print_line(f"{'redone' if redo else 'undone'}: {done.words}, by {name}")


REMOVE_AUTHOR = "annotator project remove"


def run_remove(project: Path, recording: str | None = None, /, *, yes: options.Yes = False) -> None:
    """Remove a recording from a project, or a whole project. Nothing is deleted.

    The labels of a removed recording stay in the project's history. They come back when it is added again. A removed
    project is moved to the folder `.removed` beside the projects, where you can delete it.

    Args:
        recording: name of the recording; default: the whole project.
    """
    if recording is None:
        _whole(project, yes)
        return
    with open_project(project) as opened:
        stored = opened.recordings.find(recording)
        labels = amount(opened.recordings.label_counts().get(stored.id, 0), "label")
        question = f"Remove {recording} from {project.name}, with {labels}? Adding it again brings back its labels."
        require_yes(question, yes)
        opened.recordings.remove(stored.id, REMOVE_AUTHOR)
    print_line(f"removed {recording} with {labels}; its files are unchanged")
    words = f"annotator add {project.name} {stored.path}"
    print_line(f"bring it back with: {words}" + (", and the options it was added with" if stored.options else ""))


def _whole(folder: Path, yes: bool) -> None:
    require_yes(
        f"Remove the project {folder.name}{_content(folder)}? It is moved to {folder.parent / '.removed'}.", yes
    )
    aside = set_aside(folder)
    print_line(f"moved {folder} to {aside}; delete that folder to free its space")
    print_line(f"bring it back with: annotator project copy {aside} {folder.name}")


def _content(folder: Path) -> str:
    """Such as " (recordings: 2, labels: 14)"; "" for a damaged project, which can be removed, too."""
    try:
        with open_project(folder) as opened:
            counts = opened.statistics()
    except AnnotatorError:
        return ""
    return f" (recordings: {counts.recordings}, labels: {counts.labels.total})"


def run_rename(project: Path, new_name: str, /) -> None:
    """Rename a project and its folder. Its automatic backups go with it.

    Args:
        new_name: the new name.
    """
    print_line(f"renamed {project.name} to {rename_project(project, new_name)}")


# Files that a message lists.
MOST_NAMED = 5


def run_backup(
    project: Path,
    file: Path | None = None,
    /,
    *,
    models: options.ModelsOption[ModelChoice] = ModelChoice.ALL,
) -> None:
    """Write a backup of a project, as of one moment, while a server or a job may go on writing.

    The file holds settings, database, images of pseudo-views and detectors. It does not hold the recordings.

    Args:
        file: the file to write; default: PROJECT-TIME.zip in this folder.
    """
    moment = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    out = Path(f"{project.name}-{moment}.zip") if file is None else file
    with counted("copying files") as progress:
        backup = back_up(project, out, models, progress=progress)
    manifest = backup.manifest
    print_line(f"{out}: {amount(manifest.labels, 'label')}, {amount(manifest.count, 'file')}")
    print_missing(backup.missing)
    print_line(f"restore it with: annotator project restore {out} NAME")


def print_missing(names: Sequence[str]) -> None:
    """Names the files that a project refers to, and that are not there."""
    if names:
        files = first_few(names, MOST_NAMED)
        print_line(f"the project lacks {amount(len(names), 'file')} of its pseudo-views or detectors: {files}")


def run_restore(file: Path, name: str | None = None, /, *, projects: options.Projects = None) -> None:
    """Make a project of a backup. All of it is checked first; an existing project is never replaced.

    Args:
        file: a file that `annotator project backup` or a server has written.
        name: name of the new project; default: that of the backup.
    """
    with counted("unpacking files") as progress:
        path, manifest = restore(file, options.projects_root(projects), name, progress)
    moment = datetime.fromtimestamp(manifest.created_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    print_line(f"restored {path}: {amount(manifest.labels, 'label')}, as of {moment}")


FAULTY = 1


def run_verify(project: Path, /, *, deep: bool = False, as_json: options.AsJson = False) -> int:
    """Check whether a project is sound: its database, and that its tables are exactly those of its version.

    Nothing is changed, and a server may go on writing. The exit code is 1 if there are problems.

    Args:
        deep: also replay all events and compare, and check the hashes of all images and detectors.
    """
    result = verify(project, deep=deep)
    if result.problems or as_json:
        report_problems(result, project, as_json)
    else:
        print_line(f"{project.name}: sound")
    return FAULTY if result.problems else 0


def report_problems(result: Verification, folder: Path, as_json: bool) -> None:
    """Prints the result of a verification of the project in `folder`."""
    newest = automatic_backups(folder)[-1:]
    where = f" such as {newest[0]}, the newest automatic one" if newest else ""
    lines = [
        *result.problems,
        f"{result.project}: {amount(len(result.problems), 'problem')}",
        f"`annotator project restore` restores a backup{where}; `annotator project repair` saves what it can",
    ]
    print_result(result, lines, as_json)


def run_repair(project: Path, new_name: str | None = None, /) -> None:
    """Repair a project: make a new one of all that can be read of it. The damaged project stays as it is.

    Args:
        new_name: name of the new project; default: the old name with `-repaired`.
    """
    done = repair(project, new_name)
    events = amount(done.events, "event")
    print_line(f"{done.path}: a new project with {events}; the damaged project is unchanged")
    if done.lost:
        one = {table: "pass" if table == "passes" else table.removesuffix("s") for table in done.lost}
        lost = ", ".join(amount(count, one[table]) for table, count in sorted(done.lost.items()))
        print_line(f"missing, unreadable or unusable: {lost}; compare with the newest backup")
    if done.restored:
        print_line(f"taken from the damaged tables, because their events are lost: {amount(done.restored, 'state')}")
    print_missing(done.missing)


def run_copy(
    source: str,
    name: str,
    /,
    *,
    without_labels: bool = False,
    models: options.ModelsOption[ModelChoice] = ModelChoice.ALL,
    projects: options.Projects = None,
) -> None:
    """Copy a project, or take in one that somebody else has sent, without trusting it.

    Its database is verified, and only the regular files that a project consists of are copied: no links and no caches.

    Args:
        source: name of a project, or the folder of one.
        name: name of the new project.
        without_labels: copy the recordings and the detectors only, no labels and boxes.
    """
    root, (folder, _) = options.projects_root(projects), options.place_of(source, projects)
    is_sent = folder.parent.resolve() != root.resolve()
    with counted("copying files") as progress:
        path = copy_project(folder, root, name, models, progress, labels=not without_labels, sent=is_sent)
    with open_project(path) as project:
        print_line(f"copied {folder} to {path}" + (" without its labels" if without_labels else ""))
        for recording in project.recordings.all():
            state = "" if recording.path.exists() else " (not on this computer: annotator project move)"
            print_line(f"it reads the recording {recording.name} from {recording.path}{state}")
