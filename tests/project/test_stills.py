"""Objects that stand still: their one box in the world, as the frames show it, and the queries that find it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation
from store_samples import box_at, by_hand, revised, version_of

from annotator.project import REVIEWED, FramePart, NewLabel, Project, create_project, open_project
from annotator.project.backup.verify import verify
from annotator.project.changes import LabelChanged, LabelDeleted, StillMade, StillProposal, StillsProposed
from annotator.project.database.migrations import APPLICATION_ID, MIGRATIONS
from annotator.project.database.store import driver_of
from annotator.project.lanes import read_lanes
from annotator.project.records import BoxRecord
from annotator.project.review import By, waiting
from annotator.project.rows import still_of
from annotator.project.stills import Sighting
from annotator.types import Correction, OrientedBox, ReviewState, Source
from annotator.types.errors import ProjectError, StaleRevisionError

FRAMES = 4


def make(project: Project, frame: int, box: OrientedBox, track_id: int = 1) -> str:
    """Labels an object that stands still, and that all frames see; returns its uid."""
    new = NewLabel("hand", box, track_id=track_id)
    project.labels.create(frame, [new], revised(project, frame))
    made = StillMade(uid=new.uid)
    seen = [Sighting(made.still, each.id, each.moment_id, True) for each in project.frames.of()]
    project.stills.change([FramePart(frame, [made], revised(project, frame))], seen)
    return made.still


def with_poses(folder: Path, poses: list[RigidTransform]) -> Project:
    project = create_project(folder, "still", ("hand", "person"))
    keys = [str(n) for n in range(len(poses))]
    project.recordings.add(folder / "take", "rgbd", "take", keys, True, poses=dict(zip(keys, poses, strict=True)))
    return project


AXIS = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
POSES = st.lists(st.tuples(AXIS, AXIS), min_size=FRAMES, max_size=FRAMES)
ORIGIN = st.sampled_from([(0.0, 0.0, 0.0), (500_000.0, 4_649_776.0, 12.0)])


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(moves=POSES, origin=ORIGIN, center=AXIS, turn=AXIS, correction=st.none() | AXIS)
def test_the_box_that_a_frame_shows_is_the_one_in_the_world(
    tmp_path_factory: pytest.TempPathFactory,
    moves: list[tuple[tuple[float, ...], tuple[float, ...]]],
    origin: tuple[float, ...],
    center: tuple[float, ...],
    turn: tuple[float, ...],
    correction: tuple[float, float, float] | None,
) -> None:
    poses = [
        RigidTransform.from_components(np.array(origin) + place, Rotation.from_rotvec(turned))
        for place, turned in moves
    ]
    with with_poses(tmp_path_factory.mktemp("p"), poses) as project:
        frames = [frame.id for frame in project.frames.of()]
        if correction is not None:
            project.adjustments.correct(1, Correction((0.0, 0.1, 0.0), correction), "ann")
        box = OrientedBox.from_parts(
            np.array(center), Rotation.from_rotvec(turn).as_matrix(), np.array([1.0, 2.0, 3.0])
        )
        make(project, frames[0], box)
        (still,) = project.stills.of(1)
        T_camera_world = project.stills.poses(1)
        for frame in frames:
            (label,) = project.labels.of_frame(frame)
            again = label.box.transformed(T_camera_world[frame].inv())
            assert again.pose == pytest.approx(still.box.pose, abs=1e-8 if origin[0] else 1e-9)
        # a box that is saved as it is shown stays bit for bit
        saved = LabelChanged(uid=label.uid, state=ReviewState.EDITED, box=BoxRecord.of(label.box))
        project.log.append(frames[-1], [saved], revised(project, frames[-1]))
        (again_still,) = project.stills.of(1)
        assert (again_still.box.pose == still.box.pose).all() and again_still.state is ReviewState.EDITED


@pytest.fixture
def posed(tmp_path: Path) -> Project:
    step = RigidTransform.from_translation([0.1, 0.0, 0.0])
    return with_poses(tmp_path, [step for _ in range(FRAMES)])


def test_it_needs_a_track_and_a_pose_and_keeps_its_number(posed: Project, project: Project, frame: int) -> None:
    first = posed.frames.of()[0].id
    loose = NewLabel("hand", box_at())
    posed.labels.create(first, [loose], revised(posed, first))
    with pytest.raises(ProjectError, match="has no track"):
        posed.log.append(first, [StillMade(uid=loose.uid)], revised(posed, first))
    make(posed, first, box_at(2.0))
    (label,) = [each for each in posed.labels.of_frame(first) if each.track_id == 1]
    with pytest.raises(ProjectError, match="stands still, and keeps its number"):
        posed.log.append(first, [LabelChanged(uid=label.uid, track_id=7)], revised(posed, first))
    with pytest.raises(ProjectError, match="does not say where its camera was"):
        make(project, frame, box_at())
    assert posed.labels.next_track_id(1) == 2


def test_a_frame_without_its_pose_no_longer_shows_it(posed: Project) -> None:
    make(posed, posed.frames.of()[0].id, box_at())
    keys = [frame.key for frame in posed.frames.of()]
    pose = RigidTransform.from_translation([0.1, 0.0, 0.0])
    posed.recordings.rescan(1, keys, poses=dict.fromkeys(keys[1:], pose))
    assert [len(posed.labels.of_frame(frame.id)) for frame in posed.frames.of()] == [0, 1, 1, 1]


@pytest.mark.parametrize(
    "read",
    [
        lambda project, frame: project.labels.of_frame(frame),
        lambda project, _: project.labels.along(1),
        lambda project, _: project.labels.along(1, tracks=[1]),
        lambda project, _: project.labels.select(states=[ReviewState.ACCEPTED], recordings=[1]),
        lambda project, frame: project.labels.get(project.labels.of_frame(frame)[0].uid),
        lambda project, _: project.labels.near([(2, box_at(), 1)]),
        lambda project, _: project.labels.count(recordings=[1]),
    ],
    ids=["frame", "along", "track", "select", "label", "near", "count"],
)
def test_no_query_of_labels_reads_all_of_them(posed: Project, read: object) -> None:
    """With the union of both kinds of labels, SQLite still finds each by an index."""
    frame = posed.frames.of()[0].id
    make(posed, frame, box_at())
    said = list[str]()
    with posed.store.read() as connection:
        driver_of(connection).set_trace_callback(said.append)
    read(posed, frame)  # type: ignore[operator]
    with posed.store.read() as connection:
        driver = driver_of(connection)
        driver.set_trace_callback(None)
        selects = [sql for sql in said if sql.lstrip().startswith("SELECT") and ("labels" in sql or "stills" in sql)]
        plans = [row[3] for sql in selects for row in driver.execute(f"EXPLAIN QUERY PLAN {sql}")]
    assert selects, said
    assert not [plan for plan in plans if plan.startswith(("SCAN labels", "SCAN sightings", "MATERIALIZE"))]


def test_a_project_of_version_1_is_upgraded(posed: Project, tmp_path: Path) -> None:
    """Its rows stay, and its history is that of a class without the new column."""
    frame = posed.frames.of()[0].id
    posed.labels.create(frame, [NewLabel("person", box_at(), track_id=4)], by_hand())
    posed.close()
    new, old = posed.path / "project.db", posed.path / "old.db"
    with closing(sqlite3.connect(old, isolation_level=None)) as connection:
        for statement in MIGRATIONS[0]:
            connection.execute(statement)
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute("PRAGMA user_version = 1")
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("ATTACH ? AS new", (str(new),))
        tables = "SELECT name FROM main.sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite%'"
        for (table,) in connection.execute(tables).fetchall():
            columns = ", ".join(f'"{row[1]}"' for row in connection.execute(f"PRAGMA main.table_info({table})"))
            connection.execute(f"INSERT INTO main.{table} ({columns}) SELECT {columns} FROM new.{table}")
    old.replace(new)
    assert version_of(new) == 1
    with open_project(posed.path) as project:
        assert version_of(new) == 2
        assert [label.label for label in project.labels.of_frame(frame)] == ["person"]
        assert project.frames.of()[0].revision == 1
        assert project.stills.poses(1) == {}
    assert verify(posed.path, deep=True).problems == ()


def test_what_detectors_find_of_it_is_covered(posed: Project) -> None:
    make(posed, posed.frames.of()[0].id, box_at())
    third = posed.frames.of()[2].id
    other = NewLabel("hand", box_at(9.0), 0.9, track_id=1)
    (brought,) = posed.proposals.bring("their detector", {third: [NewLabel("hand", box_at(0.05), 0.9), other]}).values()
    assert brought.is_open == (False, True)
    assert [label.track_id for label in posed.labels.of_frame(third)] == [1, None], "its track is taken there"


def proposed_still(project: Project) -> StillProposal:
    """Proposes an object that stands still, which all frames see, the second one best."""
    first = project.frames.of()[0].id
    new = StillProposal("hand", box_at(1.0), 1, 0.5, 0.5)
    project.log.append(first, [StillsProposed([new])], replace(revised(project, first), source=Source.AUTO))
    project.stills.keep(
        [
            Sighting(new.uid, each.id, each.moment_id, True, 9 if each.index == 1 else 5 - (each.index or 0), 0.0, "")
            for each in project.frames.of()
        ]
    )
    return new


def test_what_is_only_proposed_is_not_reviewed(posed: Project) -> None:
    proposed_still(posed)
    assert posed.labels.frames(states=REVIEWED) == frozenset()
    forecast = posed.statistics().progress.forecast
    assert (forecast.frames_done, forecast.frames_left, forecast.proposals_open) == (0, FRAMES, FRAMES)
    frame = posed.frames.of()[0].id
    posed.frames.finalise(frame, revised(posed, frame))
    forecast = posed.statistics().progress.forecast
    assert (forecast.frames_done, forecast.frames_left, forecast.proposals_open) == (1, FRAMES - 1, FRAMES - 1)
    (label,) = posed.labels.of_frame(frame)
    posed.log.append(frame, [LabelChanged(uid=label.uid, state=ReviewState.ACCEPTED)], revised(posed, frame))
    review = posed.statistics()
    assert (review.progress.forecast.frames_done, review.accepted_untouched) == (FRAMES, 1.0)
    (of_class,) = review.progress.proposals.by_class.values()
    assert (of_class.untouched, of_class.missed) == (FRAMES, 0)
    # a moment that was looked through later changes what is counted
    last, (still,) = posed.frames.of()[-1], posed.stills.of(1)
    posed.stills.keep([Sighting(still.uid, last.id, last.moment_id, False, 0, 0.0, "")])
    assert posed.statistics().progress.forecast.frames_done == FRAMES - 1


def test_an_open_object_waits_in_a_frame_that_shows_it(posed: Project) -> None:
    frames = [each.id for each in posed.frames.of()]
    new = proposed_still(posed)
    (item,), _ = waiting(posed.store, By.DOUBT)
    assert item.frame.id == frames[1]
    # not visible there after all
    posed.log.append(frames[1], [LabelDeleted(uid=item.uid or "", here=True)], revised(posed, frames[1]))
    (item,), total = waiting(posed.store, By.DOUBT)
    assert (item.frame.id, total, still_of(item.uid or "")) == (frames[0], 1, new.uid)


def test_a_number_whose_object_was_rejected_may_move(posed: Project) -> None:
    proposed_still(posed)
    frame = posed.frames.of()[0].id
    (label,) = posed.labels.of_frame(frame)
    assert [lane.still for lane in read_lanes(posed.store, 1).lanes] == [True]
    posed.log.append(frame, [LabelChanged(uid=label.uid, state=ReviewState.REJECTED)], revised(posed, frame))
    posed.labels.create(frame, [NewLabel("hand", box_at(3.0), track_id=1)], revised(posed, frame))
    assert [lane.still for lane in read_lanes(posed.store, 1).lanes] == [False]


def test_a_pass_does_not_remove_what_was_decided_in_a_frame_that_it_does_not_change(posed: Project) -> None:
    first, second, *_ = posed.frames.of()
    new = StillProposal("hand", box_at(1.0), 1, 0.5, 0.5)
    pass_of = replace(revised(posed, first.id), source=Source.AUTO)
    posed.log.append(first.id, [StillsProposed([new])], pass_of)
    posed.stills.keep([Sighting(new.uid, second.id, second.moment_id, True)])
    (shown,) = posed.labels.of_frame(second.id)
    again = StillsProposed([StillProposal("hand", box_at(1.0), 2, 0.5, 0.5)], [new.uid])
    accept = LabelChanged(uid=shown.uid, state=ReviewState.ACCEPTED)
    posed.log.append(second.id, [accept], revised(posed, second.id))
    pass_of = replace(revised(posed, first.id), source=Source.AUTO)
    with pytest.raises(StaleRevisionError, match="an object that stands still"):
        posed.log.append(first.id, [again], pass_of)
    assert [(each.uid, each.state) for each in posed.stills.of(1)] == [(new.uid, ReviewState.ACCEPTED)]
