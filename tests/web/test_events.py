"""Events to the open pages: changes by this server and by other processes, presence, and slow pages."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest
from live_server import PATIENCE_S
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from annotator.project import Project, WriteContext, open_project
from annotator.project.classes.edit import RenameClass
from annotator.types import Correction
from annotator.web.hub import Client, Hub
from annotator.workflows.add_recordings import bring_back

if TYPE_CHECKING:
    from live_server import Live

WaitFor = Callable[[Callable[[], Any]], None]


def listen(live: Live, project: str | None = "room", name: str = "Ada") -> ClientConnection:
    query = "" if project is None else f"?project={project}"
    # max_queue=None: a client with a full queue would not read the server's close frame
    return live.listen(query, f"annotator_operator={name}", max_queue=None)


def next_of(socket: ClientConnection, kind: str) -> dict[str, Any]:
    """The next event of a kind."""
    end = time.monotonic() + PATIENCE_S
    while True:
        message: dict[str, Any] = json.loads(socket.recv(timeout=end - time.monotonic()))
        if message["type"] == kind:
            return message


def finalise(project: Project, author: str) -> int:
    """Changes a frame; returns its id."""
    frame = project.frames.of()[2]
    project.frames.finalise(frame.id, WriteContext(frame.revision, author))
    return frame.id


def test_what_any_process_changes_is_announced_once_to_pages_of_its_project(live: Live) -> None:
    with (
        listen(live) as socket,
        listen(live, None) as other,
        open_project(live.settings.projects_root / "room") as project,
    ):
        next_of(socket, "presence")
        frame, of_server = finalise(project, "the command line"), live.context.project("room")
        expected = {"type": "frame", "project": "room", "frame": frame, "revision": 1, "operator": "the command line"}
        assert next_of(socket, "frame") == expected
        project.frames.reopen(frame, WriteContext(1, "Bob"))
        for _ in range(3):
            live.context.announcer.announce(of_server)
        finalise(project, "Eve")
        for expected_next in ((2, "Bob"), (3, "Eve")):
            event = next_of(socket, "frame")
            assert (event["revision"], event["operator"]) == expected_next

        project.change_classes(RenameClass(name="person", new="human"), "Cleo")
        expected = {"type": "classes", "project": "room", "renamed": {"person": "human"}, "operator": "Cleo"}
        assert next_of(socket, "classes") == expected
        project.adjustments.correct(1, Correction((0.0, 0.1, 0.0), (0.0, 0.0, 0.0)), "annotator calibrate")
        event = next_of(socket, "adjusted")
        assert (event["recording"], event["operator"]) == (1, "annotator calibrate")
        project.recordings.remove(1, "Bob")
        event = next_of(socket, "recordings")
        assert (event["recording"], event["operator"]) == (1, "Bob")
        bring_back(project, 1)
        assert next_of(socket, "recordings")["recording"] == 1
        with pytest.raises(TimeoutError):
            other.recv(timeout=0.2)


def test_a_page_hears_what_was_changed_while_it_connected_and_nothing_older(live: Live) -> None:
    project = live.context.project("room")
    finalise(project, "Ada")
    live.context.announcer.begin(project)
    project.frames.reopen(project.frames.of()[2].id, WriteContext(1, "Bob"))

    async def scenario() -> list[str]:
        live.context.hub.join(client := Client("room", "Ada"))
        live.context.announcer.announce(project)
        await asyncio.sleep(0)
        live.context.hub.leave(client)
        return [json.loads(client.queue.get_nowait())["type"] for _ in range(client.queue.qsize())]

    assert asyncio.run(scenario()) == ["presence", "frame"]


def test_pages_see_the_operators_of_open_frames(live: Live, wait_for: WaitFor) -> None:
    with listen(live) as ada, listen(live, name="Bob") as bob:
        ada.send(json.dumps({"type": "open", "frame": 3}))
        wait_for(lambda: next_of(bob, "presence")["frames"] == {"3": ["Ada"]})
        bob.send(json.dumps({"type": "open", "frame": 3}))
        wait_for(lambda: next_of(ada, "presence")["frames"] == {"3": ["Ada", "Bob"]})
        assert live.context.hub.open_by("room", 3, "Ada") == ["Bob"]
        bob.send(json.dumps({"type": "close"}))
        wait_for(lambda: next_of(ada, "presence")["frames"] == {"3": ["Ada"]})
        bob.send(json.dumps({"type": "open", "frame": 4}))
    wait_for(lambda: live.context.hub.presence("room") == {})


@pytest.mark.parametrize("message", ["", "{", "[]", '{"type": "open"}', '{"type": "open", "frame": -1}', b"x"])
def test_invalid_messages_close_the_socket(live: Live, message: str | bytes, wait_for: WaitFor) -> None:
    with listen(live) as socket:
        socket.send(message)
        with pytest.raises(ConnectionClosed):
            while True:
                socket.recv(timeout=PATIENCE_S)
    wait_for(lambda: not live.context.hub.clients())


def test_a_slow_page_does_not_delay_others(live: Live, wait_for: WaitFor) -> None:
    """The slow page does not read at all: its queue fills up, and the server disconnects it."""
    slow = live.listen(cookie="annotator_operator=Slow", max_queue=1, close_timeout=0.1)
    with listen(live) as quick:
        next_of(quick, "presence")
        filling = {"type": "frame", "project": "room", "text": "x" * 20_000}
        for number in range(2000):
            live.context.hub.send({**filling, "number": number})
            if number % 50 == 49:
                while next_of(quick, "frame")["number"] < number:
                    pass
        wait_for(lambda: [client.operator for client in live.context.hub.clients() if not client.dropped] == ["Ada"])
    slow.close()


def test_events_of_a_viewport_go_to_the_pages_of_its_operator() -> None:
    async def scenario() -> list[int]:
        hub, clients = Hub(), (Client("room", "A"), Client("room", "B"), Client("hall", "A"))
        for client in clients:
            hub.join(client)
        hub.send({"type": "viewport", "project": "room"}, "A")
        await asyncio.sleep(0)
        return [client.queue.qsize() for client in clients]

    assert asyncio.run(scenario()) == [2, 1, 1], "each has its presence"
