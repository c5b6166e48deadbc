"""The README's moving picture, docs/workbench.webp: drag, dashed box, Space, follow, review, on the running page."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from page import DOCS, chromium, corners_on_page, go_to, shot, signed_in, wait_for_3d, workbench
from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Page
from scenes import true_boxes

from annotator.project import BoxRotation, ProjectSettings, create_project
from annotator.recordings import open_recording
from annotator.synthetic import write_generated
from annotator.workflows.add_recordings import register_recording

FRAMES, SEED = 16, 2
SIZE, QUALITY, MOST_BYTES = (1024, 576), 62, 1_500_000
BAR = 34
DRAG_STEPS, SHOWN_FRAMES = 7, 8
POINTER = ((0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (12, 12))
NEXT_MS = 2_500


@dataclass
class Film:
    """The pictures of the page, each with its duration."""

    page: Page
    pictures: list[Image.Image] = field(default_factory=list)
    durations_ms: list[int] = field(default_factory=list)

    def take(self, text: str, duration_ms: int, pointer: tuple[float, float] | None = None) -> None:
        """Adds what the page shows, with a caption, and the mouse pointer, which screenshots lack."""
        picture = shot(self.page)
        scale = SIZE[0] / picture.width
        picture = picture.resize(SIZE, Image.Resampling.LANCZOS)
        whole = Image.new("RGB", (SIZE[0], SIZE[1] + BAR), (24, 28, 36))
        whole.paste(picture, (0, BAR))
        draw = ImageDraw.Draw(whole)
        draw.text((12, BAR / 2), text, (255, 255, 255), ImageFont.load_default(19), anchor="lm")
        if pointer is not None:
            x, y = pointer[0] * scale, pointer[1] * scale + BAR
            draw.polygon([(x + u, y + v) for u, v in POINTER], (255, 255, 255), (0, 0, 0), 1)
        self.pictures.append(whole)
        self.durations_ms.append(duration_ms)

    def save(self, path: Path) -> None:
        """Writes the film.

        Raises:
            ValueError: it is too large for a README.
        """
        first, *others = self.pictures
        first.save(
            path, save_all=True, append_images=others, duration=self.durations_ms, loop=0, quality=QUALITY, method=6
        )
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"{path.name} has {path.stat().st_size} bytes; at most {MOST_BYTES}")


def main() -> None:
    with TemporaryDirectory() as folder:
        root, recording = Path(folder), Path(folder) / "room"
        write_generated(recording, "people", FRAMES, SEED)
        settings = ProjectSettings(rotation=BoxRotation.UPRIGHT)
        with create_project(root, "people", ("person",), settings=settings) as project:
            register_recording(project, open_recording(recording))
        with workbench(root) as address, chromium() as browser:
            page = signed_in(browser, address)
            film = Film(page)
            go_to(page, "people/annotate/1")
            draw(film, recording)
            follow(film)
            review(film)
            film.save(DOCS / "workbench.webp")


def draw(film: Film, recording: Path) -> None:
    """One box on the image; the 3D box; Space."""
    page, text = film.page, "1   Drag one box on the image"
    camera, boxes = true_boxes(recording, 0)
    page.get_by_test_id("views-pseudo").click()
    page.get_by_test_id("kind-box").click()
    page.get_by_test_id("views-along").click()
    start, end = corners_on_page(page, "image-editor", boxes[-1], camera)
    wait_for_3d(page)
    page.mouse.move(*start)
    film.take(text, 700, start)
    page.mouse.down()
    for step in range(1, DRAG_STEPS + 1):
        x, y = (a + (b - a) * step / DRAG_STEPS for a, b in zip(start, end, strict=True))
        page.mouse.move(x, y)
        film.take(text, 90, (x, y))
    page.mouse.up()
    page.get_by_test_id("ortho-side").locator("rect.line").wait_for()
    wait_for_3d(page)
    film.take("2   The 3D box is there, with views along its axes", 1900, end)
    page.keyboard.press("Space")
    page.locator('[data-testid="frame-box"][data-state="accepted"]').wait_for()
    page.wait_for_timeout(NEXT_MS)
    film.take("3   Space takes it", 1100)


def follow(film: Film) -> None:
    """The box is followed, and shown in the next frames."""
    page, text = film.page, "4   V follows it through the recording"
    page.get_by_test_id("queue-order").select_option("time")
    wait_for_3d(page)
    page.keyboard.press("v")
    page.get_by_test_id("follow").locator("xpath=self::*[not(@data-state='running')]").wait_for()
    page.get_by_test_id("ortho-side").locator("rect.line").wait_for()
    wait_for_3d(page)
    film.take(text, 700)
    for _ in range(SHOWN_FRAMES):
        page.keyboard.press("Shift+N")
        page.wait_for_timeout(NEXT_MS)
        film.take(text, 170)


def review(film: Film) -> None:
    """Three boxes are accepted."""
    page, text = film.page, "5   Space accepts, X rejects, any edge can be dragged"
    page.get_by_test_id("queue-item").first.click()
    page.wait_for_timeout(NEXT_MS)
    film.take(text, 600)
    for _ in range(4):
        page.keyboard.press("Space")
        page.wait_for_timeout(NEXT_MS)
        film.take(text, 450)
    film.durations_ms[-1] = 1500
