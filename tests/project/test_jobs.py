"""The frames that a batch must process; kills at any moment and concurrent processes lose no write."""

from __future__ import annotations

import random
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from store_samples import by_hand, by_machine, proposal_at, state_of

from annotator.project import Project, RunShare, Status, StoredModel, StoredRecording, open_project
from annotator.project.jobs import Run
from annotator.types import BoxKind, DetectorKind
from annotator.types.errors import FinalisedFrameError, ProjectError, StaleRevisionError


def _start(project: Project, config: str = "{}") -> Run:
    return project.jobs.start(image_detector="image-1", view_detector="view-1", config_json=config)


def _do(project: Project, run: Run, key: str, proposals: int = 1) -> None:
    frame = next(frame for frame in project.frames.of() if frame.key == key)
    found = [proposal_at(5.0 * n) for n in range(proposals)]
    project.proposals.replace(frame.id, found, by_machine(frame.revision), run=RunShare(run.id, 0.25))


def _fail(project: Project, run: Run, key: str) -> None:
    frame = next(frame for frame in project.frames.of() if frame.key == key)
    project.jobs.record_failure(run.id, frame.id, "depth/2.png: cut short", 0.1)


def _pending(project: Project, run: Run) -> str:
    return "".join(frame.key for frame in project.jobs.pending(run.key))


def test_frames_that_are_done_are_skipped(project: Project, recording: StoredRecording) -> None:
    run = _start(project)
    assert _pending(project, run) == "01234"
    _do(project, run, "0")
    _do(project, run, "3", proposals=0)
    assert _pending(project, run) == "124"
    assert project.jobs.finish(run.id).finished_ns is not None
    with open_project(project.path) as later:
        assert _pending(later, _start(later)) == "124"


def test_failed_frames_are_kept_with_their_reason_and_tried_again(project: Project, recording: StoredRecording) -> None:
    run = _start(project)
    _fail(project, run, "2")
    (result,) = project.jobs.results(status=Status.FAILED)
    assert (result.reason, result.seconds, result.proposals) == ("depth/2.png: cut short", 0.1, 0)
    assert _pending(project, run) == "01234"
    again = _start(project)
    _do(project, again, "2")
    assert _pending(project, again) == "0134"
    assert project.jobs.results(status=Status.FAILED) == ()
    (result,) = project.jobs.results()
    assert (result.run_id, result.status, result.reason, result.proposals) == (again.id, Status.DONE, None, 1)


def test_other_settings_process_all_frames_again(project: Project, recording: StoredRecording) -> None:
    first = _start(project)
    for key in "01234":
        _do(project, first, key)
    assert _pending(project, first) == ""
    second = _start(project, '{"max_steps": 3}')
    assert _pending(project, second) == "01234"
    _do(project, second, "1")
    assert _pending(project, second) == "0234"
    assert _pending(project, first) == "1", "frame 1 has the second run's proposals"


def test_a_failure_after_a_success_is_tried_again(project: Project, recording: StoredRecording) -> None:
    run = _start(project)
    _do(project, run, "1")
    _fail(project, run, "1")
    assert _pending(project, run) == "01234"
    assert project.statistics().frames_failed == 1


def test_finalised_and_missing_frames_are_left_out(project: Project, recording: StoredRecording) -> None:
    project.frames.finalise(project.frames.find(recording.id, "1").id, by_hand())
    project.recordings.rescan(recording.id, ["4", "1", "0", "2"])
    assert _pending(project, _start(project)) == "402"


def test_refused_proposals_leave_no_result(project: Project, recording: StoredRecording, frame: int) -> None:
    run = _start(project)
    share = RunShare(run.id, 1.0)
    project.frames.finalise(frame, by_hand())
    with pytest.raises(FinalisedFrameError):
        project.proposals.replace(frame, [proposal_at()], by_machine(1), run=share)
    project.frames.reopen(frame, by_hand(1))
    with pytest.raises(StaleRevisionError):
        project.proposals.replace(frame, [proposal_at()], by_machine(1), run=share)
    with pytest.raises(ProjectError, match="no run with id 77"):
        project.proposals.replace(frame, [proposal_at()], by_machine(2), run=RunShare(77, 1.0))
    assert project.jobs.results() == ()
    assert project.labels.of_frame(frame) == ()
    assert project.frames.get(frame).revision == 2


def _register(project: Project, role: DetectorKind, name: str, activate: bool = True) -> StoredModel:
    folder = project.models_folder / name
    folder.mkdir()
    (folder / "best.pt").write_bytes(name.encode())
    (folder / "manifest.json").write_text("{}")
    return project.models.register(
        role,
        folder / "best.pt",
        labels=["hand", "person"],
        box_kind=BoxKind.SILHOUETTE,
        metrics={"map50": 0.9, "loss": float("nan")},
        fingerprint=f"sha-{name}",
        manifest=folder / "manifest.json",
        activate=activate,
    )


def _active(project: Project, role: DetectorKind) -> int:
    model = project.models.active(role)
    assert model is not None
    return model.id


def test_a_registered_model_is_read_back(project: Project) -> None:
    model = _register(project, DetectorKind.VIEW, "a")
    assert model.path == project.models_folder / "a" / "best.pt"
    assert model.manifest == project.models_folder / "a" / "manifest.json"
    assert (model.labels, model.box_kind, model.fingerprint) == (("hand", "person"), BoxKind.SILHOUETTE, "sha-a")
    assert model.metrics["map50"] == 0.9
    assert model.metrics["loss"] != model.metrics["loss"], "NaN is read back as NaN"
    assert project.models.get(model.id).path == model.path


def test_each_role_has_its_own_active_model(project: Project) -> None:
    assert project.models.active(DetectorKind.IMAGE) is None
    first = _register(project, DetectorKind.IMAGE, "a")
    second = _register(project, DetectorKind.IMAGE, "b")
    view = _register(project, DetectorKind.VIEW, "c")
    trial = _register(project, DetectorKind.IMAGE, "d", activate=False)

    assert [model.id for model in project.models.all(DetectorKind.IMAGE)] == [first.id, second.id, trial.id]
    assert _active(project, DetectorKind.IMAGE) == second.id
    assert _active(project, DetectorKind.VIEW) == view.id
    assert project.models.activate(first.id).active
    assert _active(project, DetectorKind.IMAGE) == first.id
    assert [model.active for model in project.models.all()] == [True, False, True, False]
    assert [model.id for model in project.models.all(DetectorKind.VIEW)] == [view.id]


def test_paths_of_models_inside_the_project_move_with_it(project: Project, tmp_path: Path) -> None:
    _register(project, DetectorKind.VIEW, "a")
    project.close()
    moved = project.path.rename(tmp_path / "moved")
    with open_project(moved) as reopened:
        paths = [model.path for model in reopened.models.all()]
    assert paths == [moved / "models" / "a" / "best.pt"]
    assert paths[0].is_file()


def test_models_lie_inside_the_project(project: Project, tmp_path: Path) -> None:
    outside = tmp_path / "outside.pt"
    outside.write_bytes(b"w")
    facts: dict[str, Any] = {"labels": [], "box_kind": BoxKind.BOX, "metrics": {}, "fingerprint": "f"}
    with pytest.raises(ProjectError, match=r"outside\.pt: lies outside .* copy it there"):
        project.models.register(DetectorKind.IMAGE, outside, **facts)
    _register(project, DetectorKind.VIEW, "a")
    project.close()
    for column, path in (("path", str(outside)), ("path", "../outside.pt"), ("manifest", "models/../../outside.pt")):
        with closing(sqlite3.connect(project.path / "project.db")) as database, database:
            database.execute("UPDATE models SET path = 'models/a/best.pt', manifest = NULL")
            database.execute(f"UPDATE models SET {column} = ?", [path])
        with pytest.raises(ProjectError, match=f"its view model 1 lies outside its folder, at {path}"):
            open_project(project.path)


HERE = Path(__file__).parent


@contextmanager
def _writer(project: Path) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", _RUN, str(HERE), str(HERE.parent.parent), str(project)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        with process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            try:
                yield process
            finally:
                process.kill()
    finally:
        process.wait()


# the helper's folder and the repository are on the path whatever the current directory is
_RUN = "import sys; sys.path[:0] = sys.argv[1:3]; del sys.argv[1:3]; import writer_process; writer_process.main()"


def _send(process: subprocess.Popen[str], line: str) -> None:
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def _answer(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _complete_lines(process: subprocess.Popen[str]) -> list[tuple[int, int]]:
    assert process.stdout is not None
    # the kill may truncate the last line
    lines = [line for line in process.stdout.read().splitlines(keepends=True) if line.endswith("\n")]
    return list(map(_written, lines))


def _written(line: str) -> tuple[int, int]:
    number, revision = map(int, line.split()[:2])
    return number, revision


def test_acknowledged_writes_survive_a_kill_at_any_moment(project: Project, recording: StoredRecording) -> None:
    moments = random.Random(5)
    frames = [frame.id for frame in project.frames.of()]
    project.close()
    for round_ in range(2):
        frame = frames[round_ % len(frames)]
        with _writer(project.path) as process:
            _send(process, f"loop {frame}")
            # the kill comes after some work
            first = [_written(_answer(process)) for _ in range(5)]
            time.sleep(moments.uniform(0.0, 0.2))
            process.kill()
            written = first + _complete_lines(process)
        with open_project(project.path) as reopened:
            assert reopened.problems() == []
            events = {event.id: event.revision for event in reopened.log.since()}
            assert all(events.get(number) == revision for number, revision in written)
            log = reopened.log.of_frame(frame)
            # at most one write was committed but not yet acknowledged
            assert len(log) - max((revision for _, revision in written), default=len(log)) in (0, 1)
            assert reopened.frames.get(frame).revision == len(log)
            maintained = state_of(reopened)
            assert reopened.log.rebuild() == len(events)
            assert state_of(reopened) == maintained


def test_two_processes_write_to_different_frames_and_one_of_them_on_a_revision(
    project: Project, recording: StoredRecording
) -> None:
    frames = [frame.id for frame in project.frames.of()][:2]
    rounds, wins = 10, [0, 0]
    with _writer(project.path) as one, _writer(project.path) as two:
        for revision in range(rounds):
            for process, frame in ((one, frames[0]), (two, frames[1])):
                _send(process, f"once {frame} {revision}")
        for process in (one, two):
            assert [_answer(process) for _ in range(rounds)] == ["won"] * rounds
        for revision in range(rounds, 2 * rounds):
            for process in (one, two) if revision % 2 else (two, one):
                _send(process, f"once {frames[0]} {revision}")
            answers = [_answer(process) for process in (one, two)]
            assert sorted(answers) == ["stale", "won"]
            wins[answers.index("won")] += 1
    assert sum(wins) == rounds
    assert [event.revision for event in project.log.of_frame(frames[0])] == list(range(1, 2 * rounds + 1))
    assert project.frames.get(frames[1]).revision == rounds


def test_an_error_inside_a_write_rolls_it_back(project: Project, frame: int) -> None:
    with pytest.raises(ZeroDivisionError), project.store.write() as connection:
        connection.exec_driver_sql("UPDATE frames SET revision = 7")
        _ = 1 // 0
    assert project.frames.get(frame).revision == 0


def test_a_full_disk_is_reported_and_loses_nothing(project: Project, frame: int) -> None:
    project.boxes.set_on_image(frame, [], BoxKind.BOX, by_hand())
    before = state_of(project)
    with project.store.read() as connection:  # the pool's only connection so far, so the write uses it too
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar_one()
        connection.exec_driver_sql(f"PRAGMA max_page_count = {pages + 2}")
    many = [proposal_at(5.0 * n, steps=2, views=8) for n in range(100)]
    with pytest.raises(
        ProjectError, match=r"project\.db: cannot be written, because the disk is full; nothing was changed"
    ):
        project.proposals.replace(frame, many, by_hand(1))
    assert state_of(project) == before
    assert project.problems() == []
    with open_project(project.path) as reopened:
        reopened.proposals.replace(frame, many, by_hand(1))
