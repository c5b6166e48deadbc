"""The live page in a browser: frames, figures and Pause."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from browser_page import until
from live_pages import served
from PIL import Image

from annotator.web.security import ServerSettings

if TYPE_CHECKING:
    from playwright.sync_api import Browser

STARTS_MS = 60_000.0


def test_frames_are_shown_until_paused(browser: Browser, generated: Path, tmp_path: Path) -> None:
    with served(ServerSettings(tmp_path, port=0), generated / "hands") as (url, pipeline, _):
        page = browser.new_context(viewport={"width": 1000, "height": 700}).new_page()
        page.set_default_timeout(STARTS_MS)
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(url)
        page.get_by_text("frames/s").wait_for()
        image = page.locator("img[src^='blob:'], img[src^='data:image/jpeg']").first
        image.wait_for()
        first = image.get_attribute("src")
        until(page, lambda: image.get_attribute("src") != first)
        until(page, lambda: drawn(page.screenshot()) > 0.02, 60.0)
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Resume").wait_for()
        assert pipeline.is_paused
        page.get_by_role("button", name="Resume").click()
        until(page, lambda: not pipeline.is_paused)
        assert not errors
        page.context.close()


def drawn(screenshot: bytes) -> float:
    """The fraction of the 3D view, left of the panel, that is not background."""
    view = np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB"))[160:, :540].astype(int)
    return float((np.abs(view - view[-1, 0]).max(axis=2) > 30).mean())
