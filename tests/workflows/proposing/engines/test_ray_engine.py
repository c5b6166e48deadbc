"""Ray actors on a local cluster: the same results as local workers, and sockets only on loopback."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
from engine_samples import CONFIG, HarmfulPair, stored

from annotator.project import Project
from annotator.types.errors import MissingExtraError
from annotator.workflows.detectors import Detectors
from annotator.workflows.proposing.annotate import annotate_with
from annotator.workflows.proposing.pool import Died, Event, Refused
from annotator.workflows.proposing.ray_engine import LOCAL_SWITCHES, SWITCHES, RayEngine, RayWorker, max_workers
from annotator.workflows.proposing.tasks import GivenDetectors, Storage

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


def test_results_are_bitwise_equal_even_with_a_killed_actor(
    new_people: Callable[[str], Project],
    expected: list[str],
    knowing: Callable[..., Detectors],
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


def test_without_ray_the_error_says_what_to_install(
    knowing: Callable[..., Detectors], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match="ray is not installed"):
        RayEngine(GivenDetectors(knowing("people")), 1, 1, Storage())


def test_importing_the_module_does_not_import_ray() -> None:
    code = "import sys, annotator.workflows.proposing.ray_engine; sys.exit('ray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=400).returncode == 0


def test_lost_actors_are_replaced_but_not_those_with_a_broken_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if find_spec("ray") is None:
        pytest.skip("ray is not installed")
    for name, value in (SWITCHES | LOCAL_SWITCHES).items():  # must be set before the import
        monkeypatch.setenv(name, value)
    from ray import exceptions

    told: list[Event] = []
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
        RayWorker(1, told.append, lambda call=call: SimpleNamespace(identity=call))
    assert [type(event) for event in told] == [Died, Died, Died, Died, Refused]


def test_the_number_of_workers_is_limited_per_machine() -> None:
    def node(cores: float, gpus: float = 0, alive: bool = True) -> dict[str, object]:
        return {"Alive": alive, "Resources": {"CPU": cores, **({"GPU": gpus} if gpus else {})}}

    assert max_workers([node(4), node(4), node(4, alive=False)], 8) == 0
    assert max_workers([node(4), node(7)], 3) == 3
    assert max_workers([node(16), node(4, 2), node(1, 4)], 1) == 3, "one GPU per worker"
