"""The pictures of a contact sheet: drawn in order, a few ahead, and none once the client has gone."""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress

from annotator.web.routes.tracks import AHEAD, THREADS, drawn_ahead


def test_pictures_come_in_order() -> None:
    async def read() -> list[str]:
        return [line async for line in drawn_ahead(str, range(50))]

    assert asyncio.run(read()) == [str(number) for number in range(50)]


def test_only_a_few_pictures_are_drawn_ahead() -> None:
    begun: list[int] = []

    def draw(number: int) -> str:
        begun.append(number)
        return str(number)

    async def read(most: int) -> None:
        lines = drawn_ahead(draw, range(1000))
        for number in range(most):
            assert await anext(lines) == str(number)

    asyncio.run(read(10))
    for thread in drawing():
        thread.join()
    assert len(begun) <= 10 + AHEAD


def test_drawing_stops_once_the_client_has_gone() -> None:
    begun: list[int] = []
    blocked, gate = threading.Barrier(THREADS + 1), threading.Event()

    def draw(number: int) -> str:
        begun.append(number)
        blocked.wait()
        gate.wait()
        return str(number)

    async def leave() -> None:
        reading = asyncio.ensure_future(anext(drawn_ahead(draw, range(1000))))
        await asyncio.to_thread(blocked.wait)
        reading.cancel()
        with suppress(asyncio.CancelledError):
            await reading

    asyncio.run(leave())
    gate.set()
    for thread in drawing():
        thread.join()
    assert sorted(begun) == list(range(THREADS))


def drawing() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("sheet_")]
