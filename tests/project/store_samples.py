"""Values and Hypothesis strategies for the tests of the store."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from sqlalchemy import text

from annotator.project import FramePart, NewLabel, Project, StoredFrame, WriteContext, open_project
from annotator.project.changes import LabelChanged, LabelDeleted, StillEnded, StillMade
from annotator.project.classes import edit
from annotator.project.classes.attributes import Attribute, AttributeKind, AttributeOf
from annotator.project.database import migrations
from annotator.project.database.migrations import MIGRATIONS, Migration, newest_version
from annotator.project.database.schema import AUDITED
from annotator.project.log import new_action
from annotator.project.records import BoxRecord, FramePose
from annotator.project.stills import Sighting
from annotator.types import (
    Box2D,
    BoxKind,
    BoxTrace,
    Correction,
    OrientedBox,
    Proposal,
    Quality,
    ReviewState,
    Source,
    StepTrace,
    StopReason,
    ViewTrace,
)

NOT_AXIS_ALIGNED = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()
TABLES = tuple(AUDITED)
ATTRIBUTES = (
    Attribute(name="severity", kind=AttributeKind.INTEGER, minimum=0.0, maximum=3.0, default=0),
    Attribute(name="pose", kind=AttributeKind.CHOICE, choices=("sitting", "lying"), classes=("person",)),
    Attribute(name="side", kind=AttributeKind.TEXT, of=AttributeOf.TRACK),
    Attribute(name="weather", kind=AttributeKind.NUMBER, of=AttributeOf.FRAME),
)


def by_hand(revision: int = 0, author: str = "ann") -> WriteContext:
    return WriteContext(revision, author, Source.MANUAL)


def revised(project: Project, frame: int) -> WriteContext:
    """A change by hand of the present revision of a frame."""
    return by_hand(project.frames.get(frame).revision)


def by_machine(revision: int = 0) -> WriteContext:
    return WriteContext(revision, "rcv", Source.AUTO)


def box_at(x_m: float = 0.0, size_m: float = 1.0) -> OrientedBox:
    return OrientedBox.from_parts(np.array([x_m, 0.1, 3.0]), NOT_AXIS_ALIGNED, np.array([size_m, 0.7, 0.4]))


def matrix3(array: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    return tuple(tuple(row) for row in array.tolist())


def step_trace(views: int = 2) -> StepTrace:
    axes = matrix3(NOT_AXIS_ALIGNED)
    view = ViewTrace(axes, 0.00123456789, (-0.4, 0.25), 320, 240, (Box2D("hand", 10.25, 1 / 3, 99.5, 200.125, 0.9),), 0)
    box = BoxTrace((0.1, 0.2, 0.3), axes, (1.0, 0.5, 0.25))
    return StepTrace("normals", ("consensus: too flat",), (view,) * views, box, 500, 432, StopReason.CONTINUES)


def proposal_at(
    x_m: float = 0.0, label: str = "hand", score: float = 0.75, steps: int = 1, views: int = 2, size_m: float = 1.0
) -> Proposal:
    trace = tuple(step_trace(views) for _ in range(steps))
    image_box = Box2D(label, 1.0, 2.0, 30.5, 40.25, 0.8)
    return Proposal(label, score, box_at(x_m, size_m), image_box, trace, Quality(0.125, 0.9, 0.01))


def same_box(a: OrientedBox, b: OrientedBox) -> bool:
    """Equal to the last bit."""
    return bool((a.pose == b.pose).all() and (a.size_m == b.size_m).all())


def state_of(project: Project) -> dict[str, list[tuple[object, ...]]]:
    """All rows of the audited tables, hidden ones included, ordered by their keys, without the ids."""
    state: dict[str, list[tuple[object, ...]]] = {}
    with project.store.read() as connection:
        for table in TABLES:
            rows = connection.execute(text(f"SELECT * FROM {table} ORDER BY 1")).mappings().all()
            named = table != "frames" and "id" in (rows[0] if rows else {})
            state[table] = [tuple(value for key, value in row.items() if not (named and key == "id")) for row in rows]
    return state


def sorted_state(project: Project) -> dict[str, list[tuple[object, ...]]]:
    """As `state_of`, without the order of rows that belong to different frames."""
    return {table: sorted(rows, key=str) for table, rows in state_of(project).items()}


CLASS_EDITS = (
    lambda config, b: edit.RenameClass(name=config.classes[b % len(config.classes)], new="hand" if b else "palm"),
    lambda config, b: edit.MergeClasses(names=config.classes[1:2], into=config.classes[0]),
    lambda config, b: edit.AddClass(name=("hand", "person", "palm")[b % 3]),
    lambda config, b: (
        lambda: edit.RenameAttribute(name="pose", new="posture"),
        lambda: edit.RemoveClass(name=config.classes[-1], with_boxes=True),
        lambda: edit.RemoveAttribute(name="side"),
        lambda: edit.PutAttribute(attribute=ATTRIBUTES[0], drop=True),
    )[b](),
)


def some_boxes(count: int) -> list[Box2D]:
    return [Box2D("hand", float(n), 0.0, n + 1.5, 2.0) for n in range(count)]


Step = tuple[str, int, int, int]
"""The kind of the step, the index of the frame, and two parameters from 0 to 3."""

STEPS = (
    "propose",
    "bring",
    "import",
    "create",
    "accept",
    "edit",
    "reject",
    "delete",
    "image",
    "view",
    "lock",
    "bulk",
    "track",
    "span",
    "make still",
    "still here",
    "not here",
    "make moving",
)


def actions(
    project: Project, views: list[str], step: Step, who: str, behind: int = 0
) -> dict[str, Callable[[], object]]:
    """The call for each kind in `STEPS`, `behind` revisions late; raises `ProjectError` if the state forbids it."""
    _, place, a, b = step
    frame = project.frames.of()[place]
    labels = project.labels.of_frame(frame.id)
    change, view = by_hand(frame.revision - behind, who), views[b % len(views)]
    uid = labels[a % len(labels)].uid if labels else "nobody"
    return {
        "propose": lambda: project.proposals.replace(
            frame.id,
            [proposal_at(2.0 * n + 0.1 * b, ("hand", "person")[n % 2]) for n in range(a)],
            by_machine(frame.revision - behind),
        ),
        "bring": lambda: project.proposals.bring(
            f"detector {b}",
            {
                frame.id: [
                    NewLabel(("hand", "person")[n % 2], box_at(2.0 * n + 0.15 * b), b / 4 or None) for n in range(a)
                ]
            },
        ),
        "create": lambda: project.labels.create(
            frame.id, [NewLabel("hand", box_at(2.0 * n)) for n in range(a)], change
        ),
        "accept": lambda: project.labels.accept(frame.id, uid, change),
        "edit": lambda: project.labels.edit(frame.id, uid, change, label="person", box=box_at(b), track_id=b or None),
        "reject": lambda: project.labels.reject(frame.id, uid, change),
        "delete": lambda: project.labels.delete(frame.id, uid, change),
        "image": lambda: project.boxes.set_on_image(frame.id, some_boxes(a), list(BoxKind)[b % 2], change),
        "view": lambda: project.boxes.set_on_view(view, some_boxes(a), BoxKind.BOX, change, frame_id=frame.id),
        "lock": lambda: (project.frames.reopen if frame.finalised else project.frames.finalise)(frame.id, change),
        "track": lambda: project.log.append(frame.id, [LabelChanged(uid=uid, track_id=b or None)], change),
        "import": lambda: project.proposals.bring(
            "their detector", {frame.id: [NewLabel("hand", box_at(2.0 * n), 0.9) for n in range(a)]}, who, new_action()
        ),
        "span": lambda: project.log.append_to_frames(
            # the second frame's part can be late
            [_carried_over(other, a, who, n * (b // 3)) for n, other in enumerate(project.frames.of()[:2])]
        ),
        "make still": lambda: project.stills.change(
            [
                FramePart(
                    frame.id, [LabelChanged(uid=uid, track_id=b + 1), StillMade(uid=uid, still=f"{a:032x}")], change
                )
            ],
            [Sighting(f"{a:032x}", each.id, each.moment_id, True) for each in project.frames.of()],
        ),
        "still here": lambda: project.log.append(
            frame.id, [LabelChanged(uid=uid, state=ReviewState.EDITED, box=BoxRecord.of(box_at(b)), here=True)], change
        ),
        "not here": lambda: project.log.append(frame.id, [LabelDeleted(uid=uid, here=True)], change),
        "make moving": lambda: project.log.append(
            frame.id, [StillEnded(uid=uid), NewLabel("hand", box_at(b), track_id=b + 1)], change
        ),
        "adjust": lambda: project.adjustments.correct(
            frame.recording_id, Correction((0.1 * a, 0.0, -0.2 * b), (0.0, 0.3 * b, 0.1 * a)), who
        ),
        "estimate": lambda: project.estimates.keep(
            1,  # whose frames name all moments
            [
                FramePose.of(each.key, RigidTransform.from_translation([a, b, 0.5]), 0.9, 0.01, 0.2)
                for each in project.frames.of([1])[: 9 * a]
            ],
            who,
        ),
        "values": lambda: project.labels.set_attributes(
            frame.id, uid, {"severity": a or None, "side": f"side {b}"}, change
        ),
        "frame values": lambda: project.frames.set_attributes(frame.id, {"weather": float(a) or None}, change),
        "classes": lambda: project.change_classes(lambda config: CLASS_EDITS[a](config, b)(config), who),
        "bulk": lambda: project.log.append(
            # a label that is deleted twice refuses all of it
            frame.id,
            [LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED) for label in labels]
            + [LabelDeleted(uid=uid)] * (1 + b // 3),
            change,
        ),
    }


def _carried_over(frame: StoredFrame, track_id: int, who: str, behind: int) -> FramePart:
    """One frame's part of an action that spans several frames."""
    proposal, state = None if track_id % 2 else proposal_at(9.0), ReviewState.PROPOSED
    carried = NewLabel("hand", box_at(9.0), track_id=track_id, state=state, proposal=proposal)
    return FramePart(frame.id, [carried], by_hand(frame.revision - behind, who))


def give_attributes(project: Project) -> None:
    """Gives the project the attributes `ATTRIBUTES`."""
    for attribute in ATTRIBUTES:
        project.change_classes(edit.PutAttribute(attribute=attribute), "ann")


def stored_state(project: Path) -> dict[str, list[tuple[object, ...]]]:
    with open_project(project) as opened:
        return state_of(opened)


def files(folder: Path) -> set[str]:
    """The files below a folder, without SQLite's temporary ones."""
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if not path.is_dir()}
    return {name for name in found if not name.endswith(("-wal", "-shm"))}


def damage(statement: str) -> Callable[[Path], None]:
    def change(project: Path) -> None:
        with closing(sqlite3.connect(project / "project.db", isolation_level=None)) as connection:
            connection.execute("PRAGMA writable_schema = ON")
            for each in statement.split(";;"):
                connection.execute(each)

    return change


def replace_folder(folder: Path, backup: Path) -> None:
    # as `rm -rf`: a server may remove its own files meanwhile
    while folder.exists():
        shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(backup, folder)


def replace_database(folder: Path, backup: Path) -> None:
    for left in folder.glob("project.db*"):
        left.unlink()
    with (
        closing(sqlite3.connect(backup / "project.db")) as source,
        closing(sqlite3.connect(folder / "new.db")) as target,
    ):
        source.backup(target)
    (folder / "new.db").rename(folder / "project.db")


NOW = newest_version()
NEXT: Migration = (
    "ALTER TABLE runs ADD COLUMN note TEXT",
    "CREATE INDEX labels_by_author ON labels (author, time_ns)",
)


def use_next(patch: pytest.MonkeyPatch, next_one: Migration = NEXT) -> None:
    """From now on, this process has the annotator of the next release."""
    patch.setattr(migrations, "MIGRATIONS", (*MIGRATIONS, next_one))


def version_of(database: Path) -> int:
    """The version of a database."""
    with closing(sqlite3.connect(database)) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])
