"""Batch runs: the frames processed with each combination of detectors and settings, and the reasons for failures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from dataclasses import dataclass
from enum import StrEnum

from sqlalchemy import Connection, Select, func, insert, select, update

from annotator.project.database.schema import AnyRow, adjustments, events, frame_results, frames, runs
from annotator.project.database.store import Store
from annotator.project.frames import StoredFrame, frame_of
from annotator.types.errors import NotFoundError


class Status(StrEnum):
    """Result of processing a frame."""

    DONE = "done"
    FAILED = "failed"


@dataclass(frozen=True)
class Run:
    """One batch run.

    Attributes:
        key: SHA-256 (hex) of the detectors' fingerprints and the settings.
        image_detector, view_detector: fingerprints.
        started_ns, finished_ns: UTC nanoseconds since the epoch; finished_ns is None for a running or killed run.
    """

    id: int
    key: str
    image_detector: str
    view_detector: str
    config: str
    started_ns: int
    finished_ns: int | None


@dataclass(frozen=True, eq=False)
class Jobs:
    """Starts and finishes runs, and records the result of each frame."""

    store: Store

    def start(self, *, image_detector: str, view_detector: str, config_json: str) -> Run:
        """Starts a run."""
        # the same for the same settings, whatever the order of their fields
        content = json.dumps(
            [image_detector, view_detector, json.loads(config_json)], sort_keys=True, separators=(",", ":")
        )
        row = {
            "key": hashlib.sha256(content.encode()).hexdigest(),
            "image_detector": image_detector,
            "view_detector": view_detector,
            "config": config_json,
            "started_ns": self.store.clock(),
        }
        with self.store.write() as connection:
            key = connection.execute(insert(runs), row).inserted_primary_key
            assert key is not None  # one row was inserted
            return read_run(connection, key[0])

    def finish(self, run_id: int) -> Run:
        """Records the end of a run."""
        with self.store.write() as connection:
            connection.execute(update(runs).where(runs.c.id == run_id).values(finished_ns=self.store.clock()))
            return read_run(connection, run_id)

    def all(self) -> tuple[Run, ...]:
        """All runs, the oldest first."""
        with self.store.read() as connection:
            return tuple(Run(**row._mapping) for row in connection.execute(select(runs).order_by(runs.c.id)))

    def record_failure(self, run_id: int, frame_id: int, reason: str, seconds: float) -> None:
        """Records a failure (`Proposals.replace` records a success); the next run retries the frame."""
        with self.store.write() as connection:
            record_result(connection, run_id, frame_id, seconds, reason=reason, time_ns=self.store.clock())

    def results(self, status: Status | None = None) -> tuple[AnyRow, ...]:
        """The latest result of each frame under each key, the oldest first; None = done and failed ones."""
        query = select(frame_results).order_by(frame_results.c.id)
        if status is not None:
            query = query.where(frame_results.c.status == status.value)
        with self.store.read() as connection:
            return tuple(connection.execute(query))

    def pending(self, key: str, recordings: Collection[int] | None = None) -> tuple[StoredFrame, ...]:
        """The frames that a run with this key still has to process, in order.

        Excluded are finalised frames, frames that the latest scan did not find, and those that have the proposals of a
        run with this key, made since their recording was adjusted.
        """
        adjusted = select(adjustments.c.recording_id, events.c.time_ns)
        adjusted_ns = adjusted.join(events, events.c.id == adjustments.c.event_id).subquery()
        done = (
            select(frames.c.id)
            .join(
                frame_results, (frame_results.c.frame_id == frames.c.id) & (frame_results.c.run_id == frames.c.run_id)
            )
            .outerjoin(adjusted_ns, adjusted_ns.c.recording_id == frames.c.recording_id)
            .where(
                frame_results.c.key == key,
                frame_results.c.status == Status.DONE.value,
                frame_results.c.time_ns > func.coalesce(adjusted_ns.c.time_ns, -1),
            )
        )
        query = select(frames).where(
            frames.c.finalised.is_(False), frames.c.position.is_not(None), frames.c.id.not_in(done)
        )
        if recordings is not None:
            query = query.where(frames.c.recording_id.in_(recordings))
        with self.store.read() as connection:
            return tuple(map(frame_of, connection.execute(query.order_by(frames.c.recording_id, frames.c.position))))


def latest_results() -> Select[tuple[int]]:
    """A query for the id of each frame's latest result."""
    return select(func.max(frame_results.c.id)).group_by(frame_results.c.frame_id)


def record_result(
    connection: Connection,
    run_id: int,
    frame_id: int,
    seconds: float,
    *,
    time_ns: int,
    reason: str | None = None,
    proposals: int = 0,
) -> None:
    """Records the result of a frame, replacing an earlier one under the same key; a `reason` marks a failure."""
    key = read_run(connection, run_id).key
    row = {
        "frame_id": frame_id,
        "key": key,
        "run_id": run_id,
        "status": (Status.DONE if reason is None else Status.FAILED).value,
        "reason": reason,
        "seconds": seconds,
        "proposals": proposals,
        "time_ns": time_ns,
    }
    connection.execute(insert(frame_results).prefix_with("OR REPLACE"), row)


def read_run(connection: Connection, run_id: int) -> Run:
    """One run, within the caller's transaction."""
    row = connection.execute(select(runs).where(runs.c.id == run_id)).first()
    if row is None:
        raise NotFoundError(f"the project has no run with id {run_id}")
    return Run(**row._mapping)
