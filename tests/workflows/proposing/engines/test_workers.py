"""Worker processes: the same results as inline, and nothing is lost if a worker or the driver is killed."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
from engine_samples import CONFIG, HarmfulPair, RealViews, Unloadable, stored

from annotator.project import Project, Status, open_project
from annotator.rcv.config import RcvConfig
from annotator.types.errors import MissingExtraError, WorkerError
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing.annotate import annotate_with
from annotator.workflows.proposing.engines import local_engine
from annotator.workflows.proposing.pool import Died, Fault, Message
from annotator.workflows.proposing.ray_engine import LOCAL_SWITCHES, SWITCHES, RayEngine, RayWorker, max_workers
from annotator.workflows.proposing.runner import Engine, InlineEngine
from annotator.workflows.proposing.tasks import DetectorSource, GivenDetectors, Storage

Knowing = Callable[..., Detectors]
NewPeople = Callable[[str], Project]

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
    projects = {name: new_people(name) for name in engines}
    for name, engine in engines.items():
        with closing(engine):
            assert annotate_with(projects[name], engine, config, limit=1).failed == []
    here, there = (stored(project)[:1] for project in projects.values())
    assert here == there
    assert all("Box2D" in text and "view_disagreement" in text for text in here), "boxes were detected and used"


def test_a_frame_that_kills_every_worker_is_stored_as_failed_and_the_others_are_bitwise_equal(
    new_people: NewPeople, expected: list[str], knowing: Knowing, generated: Path
) -> None:
    project = new_people("deadly")
    # read through a mirror
    elsewhere = Storage(((generated, generated.as_uri()),), cache_mb=50)
    with closing(local_engine(HarmfulPair(knowing("people"), deadly=("000004",)), 1, 1, elsewhere)) as engine:
        done = annotate_with(project, engine, CONFIG)
    ((key, reason),) = done.failed
    assert (done.done, key) == (4, "000004")
    assert "killed, possibly out of memory" in reason
    (failure,) = project.jobs.results(status=Status.FAILED)
    assert failure.reason == reason
    assert stored(project)[:4] == expected[:4]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc of Linux")
def test_a_killed_driver_leaves_no_workers_and_a_restart_continues(
    new_people: NewPeople, expected: list[str], knowing: Knowing, tmp_path: Path
) -> None:
    project, told, source = new_people("killed"), tmp_path / "told", tmp_path / "source"
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
        done = annotate_with(again, InlineEngine(GivenDetectors(knowing("people"))), CONFIG)
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
        annotate_with(new_people("stopped"), engine, CONFIG, progress=stop)
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
    project = new_people("unloadable")
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
    project, once, before = new_people("ray"), tmp_path / "once", listening()
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
        RayEngine(GivenDetectors(knowing("people")), 1, 1, Storage())


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
