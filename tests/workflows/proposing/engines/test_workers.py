"""Worker processes: the same results as inline, and nothing is lost if a worker or the driver is killed.

First the distribution of tasks with fake workers, the choice of the engine, and what workers load.
"""

from __future__ import annotations

import errno
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from itertools import cycle
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
from engine_samples import CONFIG, HarmfulPair, RealViews, Unloadable, stored

from annotator.project import Project, Status, open_project
from annotator.rcv.config import RcvConfig
from annotator.types import BoxKind
from annotator.types.errors import ConfigError, DetectionError, MissingExtraError, WorkerError
from annotator.workflows.detectors import Detectors, TrainedDetectors, UsedModel
from annotator.workflows.proposing import engines
from annotator.workflows.proposing.annotate import annotate_with
from annotator.workflows.proposing.engines import MIN_FRAMES, EngineName, local_engine, make_engine
from annotator.workflows.proposing.pool import TASKS_PER_WORKER, Died, Fault, Message, Report, WorkerPool
from annotator.workflows.proposing.ray_engine import LOCAL_SWITCHES, SWITCHES, RayEngine, RayWorker, max_workers
from annotator.workflows.proposing.runner import Engine, InlineEngine
from annotator.workflows.proposing.tasks import (
    DetectorSource,
    Identity,
    PackedDetectors,
    Storage,
    parse_elsewhere,
    scratch_folder,
)

SAME = Identity("image", "view", ("torch", "torch"), (BoxKind.BOX, False, BoxKind.BOX, False))


def pool(*messages: Message) -> WorkerPool:
    """A pool of two workers, of which each only says the next of these."""
    said = cycle(messages)

    def make(number: int, tell: Report) -> Mock:
        tell(number, next(said))
        return Mock()

    return WorkerPool(make, 2)


@pytest.mark.parametrize(
    ("messages", "error", "says"),
    [
        ([Died("killed")], WorkerError, "before they were ready, the last one killed"),
        ([SAME, replace(SAME, backends=("openvino", "torch"))], WorkerError, "detectors differ"),
        # a bug is no error of ours
        ([Fault("Traceback ...", True)], RuntimeError, "Traceback"),
    ],
)
def test_a_pool_of_unusable_workers_is_an_error(messages: list[Message], error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        pool(*messages).start_all()


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


def test_weights_are_sent_to_other_machines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "training"
    folder.mkdir()
    model = UsedModel(folder / "detector.pt", BoxKind.BOX, False, "f")
    trained = TrainedDetectors(model, model)
    with pytest.raises(DetectionError, match="train the detector again"):
        PackedDetectors.of(trained)
    (folder / "detector.pt").write_bytes(b"weights")
    (folder / "model.json").write_text("{}")
    packed = PackedDetectors.of(trained)
    shutil.rmtree(folder)

    def read(weights: Path, *_: object, **__: object) -> tuple[bytes, str]:
        return weights.read_bytes(), weights.with_name("model.json").read_text()

    monkeypatch.setattr("annotator.workflows.detectors.load_detector", read)
    loaded = packed.load(1)
    assert (loaded.image, loaded.view) == ((b"weights", "{}"),) * 2

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(DetectionError, match=r"cannot be written \(No space left on device\).*TMPDIR"):
        packed.load(1)


def test_the_folder_of_cached_recordings_is_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert scratch_folder().stat().st_mode & 0o077 == 0
    scratch_folder().chmod(0o777)
    with pytest.raises(WorkerError, match="other users can write to it"):
        scratch_folder()


Knowing = Callable[..., Detectors]
NewPeople = Callable[[], Project]

DRIVER = """
import pickle, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from annotator.project import open_project
from annotator.rcv.config import RcvConfig
from annotator.workflows.proposing.annotate import annotate_with
from annotator.workflows.proposing.engines import local_engine
from annotator.workflows.proposing.tasks import Storage
with open_project(Path(sys.argv[2])) as project, open(sys.argv[3], "rb") as file:
    annotate_with(project, local_engine(pickle.load(file), 1, 1, Storage()), RcvConfig(max_steps=1))
"""


def wait_for(condition: Callable[[], bool], what: str) -> None:
    end = time.monotonic() + 240
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.05)


def is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def engine_of(source: DetectorSource, workers: int = 2) -> Engine:
    return local_engine(source, workers, 1, Storage())


@pytest.mark.slow
def test_results_of_a_real_network_are_bitwise_equal(new_people: NewPeople, knowing: Knowing, tmp_path: Path) -> None:
    from annotator.detection.ultralytics_api import api

    model = api().DetectionModel("yolo11n.yaml", nc=1, verbose=False)
    model.names = {0: "person"}
    api().torch.save({"model": model}, tmp_path / "detector.pt")
    source, config = RealViews(knowing("people"), tmp_path / "detector.pt"), RcvConfig(max_steps=2, min_view_score=0)
    engines = {"here": InlineEngine(source, 1), "there": engine_of(source, 1)}
    projects = {name: new_people() for name in engines}
    for name, engine in engines.items():
        with closing(engine):
            assert annotate_with(projects[name], engine, config, limit=1).failed == []
    here, there = (stored(project)[:1] for project in projects.values())
    assert here == there
    labels = projects["here"].labels.select()
    # a perfect detector's scores are 1, and a box of which no view sees anything does not change
    assert labels and all(each.label.score < 1 and each.quality.last_change > 0 for each in labels)


def test_a_frame_that_kills_every_worker_fails_and_the_others_of_its_task_and_of_later_ones_are_bitwise_equal(
    new_people: NewPeople, expected: list[str], knowing: Knowing, generated: Path
) -> None:
    project = new_people()
    # read through a mirror
    elsewhere = Storage(((generated, generated.as_uri()),), cache_mb=50)
    with closing(local_engine(HarmfulPair(knowing("people"), deadly=("000002",)), 1, 1, elsewhere)) as engine:
        done = annotate_with(project, engine, CONFIG)
    ((key, reason),) = done.failed
    assert (done.done, key) == (4, "000002")
    assert "a worker has ended 2 times on this frame, the last time killed, possibly out of memory" in reason
    (failure,) = project.jobs.results(status=Status.FAILED)
    assert failure.reason == reason
    for number in (0, 1, 3, 4):
        assert stored(project)[number] == expected[number]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc of Linux")
def test_a_killed_driver_leaves_no_workers_and_a_restart_continues(
    new_people: NewPeople, expected: list[str], knowing: Knowing, tmp_path: Path
) -> None:
    project, told, source = new_people(), tmp_path / "told", tmp_path / "source"
    told.mkdir()
    source.write_bytes(pickle.dumps(HarmfulPair(knowing("people"), slow_s=0.3, told=told)))
    here = str(Path(__file__).parent)
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, here, str(project.path), str(source)])
    try:
        wait_for(lambda: len(project.jobs.results()) > 0, "the driver stores nothing")
        (pid,) = (int(path.name) for path in told.iterdir())
    finally:
        driver.kill()
        driver.wait()
    wait_for(lambda: not is_alive(pid), "the worker outlives its driver")
    project.close()
    with open_project(project.path) as again:
        done = annotate_with(again, InlineEngine(knowing("people")), CONFIG)
        assert done.skipped + done.done == 5 and done.skipped > 0
        assert stored(again) == expected
        assert again.problems() == []


def test_interrupting_the_batch_ends_the_workers(new_people: NewPeople, knowing: Knowing, tmp_path: Path) -> None:
    told = tmp_path / "told"
    told.mkdir()

    def stop(done: int, total: int) -> None:
        if any(told.iterdir()):
            raise KeyboardInterrupt

    # no frame is ever done: the heartbeat calls the progress function
    engine = engine_of(HarmfulPair(knowing("people"), slow_s=100, told=told), 1)
    with pytest.raises(KeyboardInterrupt):
        annotate_with(new_people(), engine, CONFIG, progress=stop)
    (pid,) = (int(path.name) for path in told.iterdir())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def test_detectors_that_cannot_be_loaded_are_an_error(
    new_people: NewPeople, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # workers must not import modules from the current folder
    (tmp_path / "queue.py").write_text("raise SystemExit('somebody else's queue')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place not in ("", str(tmp_path))])
    project = new_people()
    with pytest.raises(WorkerError, match="cannot be read as detector weights"):
        annotate_with(project, engine_of(Unloadable(), 1), CONFIG)
    assert project.jobs.all() == ()


LISTENS = "0A"
LOOPBACK = ("0100007F", "0000000000000000FFFF00000100007F")


def listening() -> set[tuple[str, str]]:
    """(address, port) of every listening socket of this machine, from Linux's /proc."""
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        if Path(f"/proc/net/{name}").exists()
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    return {(row[1].split(":")[0], row[1].split(":")[1]) for row in rows if row[3] == LISTENS}


@pytest.mark.slow
def test_results_are_bitwise_equal_even_with_a_killed_actor(
    new_people: NewPeople,
    expected: list[str],
    knowing: Knowing,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if find_spec("ray") is None:  # not imported here, since the switches must be set before
        pytest.skip("ray is not installed")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    project, once, before = new_people(), tmp_path / "once", listening()
    source = HarmfulPair(knowing("people"), deadly=("000001",), once=once)
    with closing(RayEngine(source, 1, 1, Storage())) as engine:
        done = annotate_with(project, engine, CONFIG)
        opened = listening() - before
    assert once.exists(), "an actor has killed itself"
    assert (done.done, done.failed) == (5, [])
    assert stored(project) == expected
    assert opened and {address for address, _ in opened} <= set(LOOPBACK)


def test_without_ray_the_error_says_what_to_install(knowing: Knowing, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match="ray is not installed"):
        RayEngine(knowing("people"), 1, 1, Storage())


def test_lost_actors_are_replaced_but_not_those_with_a_broken_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    if find_spec("ray") is None:
        pytest.skip("ray is not installed")
    for name, value in (SWITCHES | LOCAL_SWITCHES).items():  # must be set before the import
        monkeypatch.setenv(name, value)
    from ray import exceptions

    told: list[Message] = []
    for error in (
        exceptions.OutOfMemoryError("killed, the node was low on memory"),
        exceptions.NodeDiedError("its node died"),
        exceptions.ObjectLostError("00", None, ""),
        exceptions.ActorDiedError(),
        exceptions.RuntimeEnvSetupError("no such package"),
    ):
        future: Future[object] = Future()
        future.set_exception(error)
        call = SimpleNamespace(remote=lambda future=future: SimpleNamespace(future=lambda: future))
        RayWorker(1, lambda _, message: told.append(message), lambda call=call: SimpleNamespace(identity=call))
    assert [type(event) for event in told] == [Died, Died, Died, Died, Fault]


def test_the_number_of_workers_is_limited_per_machine() -> None:
    def node(cores: float, gpus: float = 0, alive: bool = True) -> dict[str, object]:
        return {"Alive": alive, "Resources": {"CPU": cores, **({"GPU": gpus} if gpus else {})}}

    assert max_workers([node(4), node(4), node(4, alive=False)], 8) == 0
    assert max_workers([node(4), node(7)], 3) == 3
    assert max_workers([node(16), node(4, 2), node(1, 4)], 1) == 3, "one GPU per worker"
