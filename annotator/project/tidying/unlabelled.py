"""Makes a project without labels of a copy of one: its recordings, their adjustments, and its detectors."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from sqlalchemy import insert, select, true

from annotator.project.adjustments import Adjustments
from annotator.project.classes.applying import CHANGED
from annotator.project.database.schema import events, frames, models, recordings
from annotator.project.database.store import Store, create_store, open_store
from annotator.project.log.writing import Writer
from annotator.project.recordings import Recordings
from annotator.project.removed import KEPT

AUTHOR = "annotator project copy"


def remove_labels(database: Path) -> None:
    """Replaces a copied database, which nobody has open, by one that has no labels, boxes and passes.

    Removed recordings and frames that are no longer there are left out. Ids stay.

    Raises:
        ProjectError: it is damaged, or the disk is full.
        OSError: the file cannot be written.
    """
    empty = database.with_name(f"{database.name}.unlabelled")
    with closing(open_store(database)) as old, closing(create_store(empty)) as new:
        _copy_rows(old, new)
        _copy_adjustments(old, new)
    empty.replace(database)


def _copy_rows(old: Store, new: Store) -> None:
    with old.read() as source, new.write() as target:
        for table, there in (
            (recordings, recordings.c.removed_ns.is_(None)),
            (frames, KEPT & frames.c.position.is_not(None)),
            (models, true()),
            # detectors that were trained before a class was renamed need them
            (events, events.c.kind == CHANGED),
        ):
            unlabelled = {"revision": 0, "finalised": False} if table is frames else {}
            rows = [{**row, **unlabelled} for row in source.execute(select(table).where(there)).mappings()]
            if rows:
                target.execute(insert(table), rows)


def _copy_adjustments(old: Store, new: Store) -> None:
    """Makes each adjustment anew, as an event without the labels that the first one moved."""
    adjustments = Adjustments(Writer(new, new.path.parent))
    for recording in Recordings(old).all():
        if not recording.adjusted or not recording.frames:
            continue
        adjustments.correct(recording.id, recording.correction, AUTHOR)
        if Recordings(new).get(recording.id).up != recording.up:
            adjustments.set_up(recording.id, recording.up, AUTHOR)
