"""Distribution of tasks, also after workers died, with fake workers; the choice of the engine; what workers load."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from engine_samples import Unloadable

from annotator.project import BoxRotation, StoredRecording
from annotator.rcv.config import RcvConfig
from annotator.rcv.finish import FrameProposals
from annotator.types import BoxKind
from annotator.types.errors import ConfigError, DetectionError, WorkerError
from annotator.workflows.detectors import TrainedDetectors, UsedModel
from annotator.workflows.proposing import engines
from annotator.workflows.proposing.engines import MIN_FRAMES, EngineName, make_engine
from annotator.workflows.proposing.pool import (
    MAX_FAILED_STARTS,
    TASKS_PER_WORKER,
    Died,
    Fault,
    Report,
    WorkerPool,
)
from annotator.workflows.proposing.runner import InlineEngine
from annotator.workflows.proposing.tasks import (
    Answer,
    FrameAnswer,
    FrameSpec,
    Identity,
    PackedDetectors,
    Storage,
    Task,
    parse_elsewhere,
    scratch_folder,
)

SAME = Identity("image", "view", ("torch", "torch"), BoxKind.BOX)
ROOM = StoredRecording(1, Path("room"), "rgbd_folder", "room", True, None, 0, 5)


@dataclass(eq=False)
class FakeWorker:
    """A worker controlled by the test."""

    number: int
    tell: Report
    tasks: list[Task] = field(default_factory=list)
    is_ended: bool = False

    def send(self, task: Task) -> None:
        self.tasks.append(task)

    def end(self) -> None:
        self.is_ended = True

    def ready(self) -> FakeWorker:
        self.tell(self.number, SAME)
        return self

    def do(self) -> None:
        task = self.tasks.pop(0)
        answers = tuple(FrameAnswer(FrameProposals(frame.key, (), ()), None, 1.0) for frame in task.frames)
        self.tell(self.number, Answer(task.number, answers))

    def die(self) -> None:
        self.tasks.clear()
        self.tell(self.number, Died("killed"))


@dataclass(eq=False)
class FakePool:
    """A pool with all workers that it has created."""

    workers: int
    made: list[FakeWorker] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.pool = WorkerPool(self._make, self.workers)

    def _make(self, number: int, tell: Report) -> FakeWorker:
        self.made.append(FakeWorker(number, tell))
        return self.made[-1]

    def start(self) -> FakePool:
        while len(self.made) < self.workers:
            self.pool._add()
        for worker in self.made:
            worker.ready()
        self.pool.start()
        self.drain()
        return self

    def drain(self) -> list[Answer]:
        answers = []
        while (answer := self.pool.wait(0.01)) is not None or not self.pool._events.empty():
            answers += [answer] if answer is not None else []
        return answers


def task(number: int, *keys: str) -> Task:
    return Task(number, "project", tuple(FrameSpec(ROOM, key) for key in keys), RcvConfig(), BoxRotation.FREE)


def keys(worker: FakeWorker) -> list[tuple[str, ...]]:
    return [tuple(frame.key for frame in held.frames) for held in worker.tasks]


def test_each_worker_gets_a_task_and_one_in_advance() -> None:
    fake = FakePool(2).start()
    for number in range(6):
        fake.pool.submit(task(number, str(number)))
    assert [len(worker.tasks) for worker in fake.made] == [TASKS_PER_WORKER, TASKS_PER_WORKER]
    fake.made[1].do()
    assert [answer.number for answer in fake.drain()] == [2]
    assert keys(fake.made[1])[-1] == ("4",)


def test_tasks_of_a_dead_worker_are_repeated_one_by_one() -> None:
    fake = FakePool(1).start()
    for number in range(4):
        fake.pool.submit(task(number, f"{number}a", f"{number}b"))
    fake.made[0].die()
    fake.drain()
    second = fake.made[1].ready()
    fake.drain()
    answers = []
    for _ in range(2):  # repeated tasks run alone
        assert len(keys(second)) == 1
        second.do()
        answers += fake.drain()
    assert len(second.tasks) == TASKS_PER_WORKER
    for _ in range(2):
        second.do()
    answers += fake.drain()
    assert sorted(answer.number for answer in answers) == [0, 1, 2, 3]
    assert all(frame.result is not None for answer in answers for frame in answer.frames)


def test_a_frame_that_kills_workers_repeatedly_fails_and_the_others_of_its_task_are_done() -> None:
    fake = FakePool(1).start()
    fake.pool.submit(task(7, "good", "deadly", "fine"))
    answers: list[Answer] = []
    for _ in range(20):
        worker = fake.made[-1]
        if not worker.tasks:
            worker.ready()
            fake.drain()
        if any("deadly" in held for held in keys(worker)):
            worker.die()
        else:
            worker.do()
        answers = fake.drain()
        if answers:
            break
    (answer,) = answers
    assert answer.number == 7
    assert [frame.result.key if frame.result else None for frame in answer.frames] == ["good", None, "fine"]
    reason = answer.frames[1].reason
    assert reason is not None and "a worker has ended 2 times on this frame, the last time killed" in reason
    assert len(fake.made) == 4, "three workers died: twice with other frames, once alone"


def test_workers_that_die_during_start_end_the_batch() -> None:
    fake = FakePool(1)
    for _ in range(MAX_FAILED_STARTS):
        fake.pool._add()
        fake.made[-1].die()
    with pytest.raises(WorkerError, match="before they were ready, the last one killed"):
        fake.pool.start()


def test_workers_with_other_detectors_are_refused() -> None:
    fake = FakePool(2).start()
    fake.made[0].tell(1, Identity("image", "view", ("openvino", "torch"), BoxKind.BOX))
    with pytest.raises(WorkerError, match="detectors differ"):
        fake.drain()


def test_a_bug_in_a_worker_is_not_an_annotator_error() -> None:
    fake = FakePool(1)
    fake.pool._add()
    fake.made[0].tell(1, Fault("Traceback ...", True))
    with pytest.raises(RuntimeError, match="Traceback"):
        fake.pool.start()


@pytest.mark.parametrize(
    ("name", "cores", "gpus", "options", "workers"),
    [
        ("auto", 4, (), {}, 4),
        ("auto", 4, (), {"workers": 1}, None),
        ("auto", 1, (), {}, None),
        ("auto", 1, ("0",), {}, 1),
        ("auto", 4, (), {"frames": MIN_FRAMES - 1}, None),
        ("local", 8, ("0", "1"), {}, 2),
    ],
)
def test_the_number_of_workers_depends_on_cores_gpus_and_frames(
    name: str,
    cores: int,
    gpus: tuple[str, ...],
    options: dict[str, int],
    workers: int | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(engines, "usable_cores", lambda: cores)
    monkeypatch.setattr(engines, "cuda_devices", lambda: gpus)
    engine = make_engine(EngineName(name), Unloadable(), **{"frames": 1000, **options})
    assert isinstance(engine, InlineEngine if workers is None else WorkerPool)
    assert engine.window == (1 if workers is None else workers * (TASKS_PER_WORKER + 1))


@pytest.mark.parametrize(
    ("name", "options", "says"),
    [
        ("local", {"workers": 0}, "--workers 0 is too small"),
        ("inline", {"workers": 2}, "has no workers"),
        ("local", {"address": "auto"}, "add --engine ray"),
    ],
)
def test_conflicting_options_are_errors(name: str, options: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        make_engine(EngineName(name), Unloadable(), frames=100, **options)


def test_paths_are_mapped_to_the_longest_matching_folder() -> None:
    storage = Storage(parse_elsewhere(["/data/a=s3://bucket/a/", "/data=/mnt/data"]))
    assert storage.place(Path("/data/a/room")) == "s3://bucket/a/room"
    assert storage.place(Path("/data/a")) == "s3://bucket/a"
    assert storage.place(Path("/data/b/room")) == "/mnt/data/b/room"
    assert storage.place(Path("/database/room")) == "/database/room"


@pytest.mark.parametrize("word", ["", "/data", "=s3://bucket", "/data="])
def test_invalid_mappings_are_errors(word: str) -> None:
    with pytest.raises(ConfigError, match="not of the form FOLDER=PLACE"):
        parse_elsewhere([word])


def test_weights_are_unpacked_once_into_a_private_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "training"
    folder.mkdir()
    model = UsedModel(folder / "detector.pt", BoxKind.BOX, False, "f")
    trained = TrainedDetectors(model, model)
    with pytest.raises(DetectionError, match="train the detector again"):
        PackedDetectors.of(trained)
    (folder / "detector.pt").write_bytes(b"weights")
    (folder / "model.json").write_text("{}")
    packed = PackedDetectors.of(trained)
    place = packed.image.unpacked(tmp_path / "out")
    for path in (place, place.with_name("model.json")):  # the system may remove temporary files one by one
        before = place.stat().st_ino
        assert packed.image.unpacked(tmp_path / "out") == place and place.stat().st_ino == before
        path.unlink()
        assert packed.image.unpacked(tmp_path / "out") == place and place.read_bytes() == b"weights"
    assert sorted(path.name for path in (tmp_path / "out").rglob("*") if path.is_file()) == [
        "detector.pt",
        "model.json",
    ]
    with pytest.raises(DetectionError, match=r"detector\.pt.*: cannot be written .*TMPDIR"):
        packed.image.unpacked(folder / "detector.pt")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert scratch_folder().stat().st_mode & 0o077 == 0
    scratch_folder().chmod(0o777)
    with pytest.raises(WorkerError, match="other users can write to it"):
        scratch_folder()
